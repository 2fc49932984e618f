"""Exact answers: a closed form, or long importance sampling with its error.

``answers.json`` keeps of each problem the moments, the log evidence with its standard
error, the probability of each region, and the proposal, from which a few thousand
draws give a reference sample again within a second.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import gammaln, logsumexp
from sklearn.mixture import GaussianMixture

from tests.oracles.problem import Array, Problem

FILE = Path(__file__).with_name("answers.json")
#: Degrees of freedom of the proposals.
DF = 6.0


@dataclass(frozen=True)
class Region:
    """What is known of the parameters within a region.

    Attributes:
        probability: Of the region.
        mean: Of theta within it, shape (d,).
        cov: Its covariance, shape (d, d).
    """

    probability: float
    mean: Array
    cov: Array


@dataclass(frozen=True)
class Answer:
    """What is known of a problem.

    Attributes:
        mean: Of theta, shape (d,).
        cov: Its covariance, shape (d, d).
        log_evidence: log Z, nats.
        error: Its standard error.
        regions: Each region, by label.
        effective: Effective draws behind all this; inf for a closed form.
        proposal: What draws as many again.
    """

    mean: Array
    cov: Array
    log_evidence: float
    error: float
    regions: dict[int, Region]
    effective: float
    proposal: Students


@dataclass(frozen=True)
class Students:
    """A mixture of Student t distributions.

    Attributes:
        weight: Shape (k,).
        mean: Shape (k, d).
        factor: Lower factors of the scales, shape (k, d, d).
    """

    weight: Array
    mean: Array
    factor: Array

    @classmethod
    def fitted(cls, u: Array, *, wider: float) -> Students:
        """Return a mixture around draws, shape (n, d).

        Args:
            u: The draws.
            wider: Factor of the covariances.
        """
        center, scale = u.mean(0), u.std(0) + 1e-12
        scaled = (u - center) / scale
        fits = []
        for components in (1, 2, 4, 8, 16):
            if len(u) < 20 * components * u.shape[1] and components > 1:
                break
            fit: Any = GaussianMixture(components, reg_covar=1e-6, random_state=0)
            fits.append(fit.fit(scaled))
        fit = min(fits, key=lambda f: f.bic(scaled))
        factor = scale[:, None] * np.linalg.cholesky(wider * fit.covariances_)
        return cls(fit.weights_, center + scale * fit.means_, factor)

    def sample(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (num, d)."""
        which = rng.choice(len(self.weight), num, p=self.weight / self.weight.sum())
        z = rng.standard_normal((num, self.mean.shape[1]))
        z *= np.sqrt(DF / rng.chisquare(DF, num))[:, None]
        return self.mean[which] + np.einsum("nij,nj->ni", self.factor[which], z)

    def log_prob(self, u: Array) -> Array:
        """Return log densities, shape (n,)."""
        d, parts = u.shape[1], []
        size = gammaln((DF + d) / 2) - gammaln(DF / 2) - d / 2 * np.log(DF * np.pi)
        for w, m, factor in zip(self.weight, self.mean, self.factor, strict=True):
            z = np.linalg.solve(factor, (u - m).T)
            volume = np.log(np.diag(factor)).sum()
            tail = (DF + d) / 2 * np.log1p((z**2).sum(0) / DF)
            parts.append(np.log(w) + size - volume - tail)
        return np.asarray(logsumexp(parts, axis=0))


@dataclass(frozen=True)
class Weighted:
    """A weighted sample of a posterior, or of one that is tempered.

    Attributes:
        u: Coordinates, shape (n, d).
        base: Log of prior over proposal, shape (n,).
        log_likelihood: Shape (n,).
        power: Of the likelihood.
    """

    u: Array
    base: Array
    log_likelihood: Array
    power: float = 1.0

    @classmethod
    def drawn(
        cls, own: Problem, proposal: Students, num: int, rng: np.random.Generator
    ) -> Weighted:
        """Return draws of a proposal with their weights."""
        u = proposal.sample(num, rng)
        blocks = np.array_split(u, 1 + num // 20_000)
        log_l = [own.log_likelihood(own.to_theta(rows)) for rows in blocks]
        log_prior = -0.5 * (u**2).sum(1) - 0.5 * own.dim * np.log(2 * np.pi)
        return cls(u, log_prior - proposal.log_prob(u), np.concatenate(log_l))

    @property
    def log_weight(self) -> Array:
        """Log of target over proposal, shape (n,)."""
        if self.power == 0:
            return self.base
        return self.base + self.power * self.log_likelihood

    @property
    def weight(self) -> Array:
        """Weights that sum to one, shape (n,)."""
        return np.exp(self.log_weight - logsumexp(self.log_weight))

    @property
    def effective(self) -> float:
        """Kish's effective sample size."""
        return float(1 / (self.weight**2).sum())

    @property
    def log_evidence(self) -> float:
        """Log of the mean weight."""
        return float(logsumexp(self.log_weight) - np.log(len(self.u)))

    @property
    def error(self) -> float:
        """Its standard error, by the scatter of the weights."""
        return float(np.sqrt(max(1 / self.effective - 1 / len(self.u), 0.0)))

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return coordinates of equal weight, shape (num, d)."""
        return self.u[rng.choice(len(self.u), num, p=self.weight)]

    def tempered(self, least: float, effective: float) -> Weighted:
        """Return it with the largest power that leaves enough effective draws.

        Args:
            least: Power to stay at where none leaves so many.
            effective: Effective draws.
        """
        if self.effective > effective:
            return self
        low, high = np.log(least), 0.0
        for _ in range(40):
            mid = (low + high) / 2
            enough = replace(self, power=np.exp(mid)).effective > effective
            low, high = (mid, high) if enough else (low, mid)
        return replace(self, power=float(np.exp(low)))


def found_proposal(own: Problem, num: int, rng: np.random.Generator) -> Students:
    """Return a proposal for the posterior, from the prior by tempering.

    Args:
        own: The problem.
        num: Draws a round.
        rng: Of all draws.
    """
    u = rng.standard_normal((num, own.dim))
    if own.is_smooth and own.dim > 3:
        u = _around_least_squares(own, num // 4, rng)
    proposal, best = Students.fitted(u, wider=2.0), None
    num_full, power = 0, 1e-12
    for _ in range(200):
        sample = Weighted.drawn(own, proposal, num, rng)
        if best is None or sample.effective > best[0]:
            best = sample.effective, proposal
        tempered = sample.tempered(power, 0.15 * num)
        power = tempered.power
        num_full += tempered.power == 1
        if num_full == 5:
            break
        # Distinct draws: components would close in on repeated ones.
        u = np.unique(tempered.draws(num // 2, rng), axis=0)
        proposal = Students.fitted(u, wider=1.5)
    return best[1]


def searched(own: Problem, num: int, rng: np.random.Generator) -> list[Any]:
    """Return least-squares fits of the coordinates, best first.

    Args:
        own: A problem whose mean can be differentiated.
        num: Searches, each from a draw of the prior.
        rng: Of these draws.
    """
    seen = np.isfinite(own.x)

    def residual(u: Array) -> Array:
        e = (own.x - own.means(own.to_theta(u[None]))[0]) / own.error.scale
        # No outcome where there was one is as far as ten deviations off.
        return np.concatenate([np.where(np.isfinite(e), e, 10.0)[seen], u])

    starts = rng.standard_normal((num, own.dim))
    fits: list[Any] = [least_squares(residual, u, max_nfev=100) for u in starts]
    return sorted(fits, key=lambda fit: fit.cost)


def covariance(fit: Any) -> Array:
    """Return the covariance of a least-squares fit, shape (d, d)."""
    return np.linalg.inv(fit.jac.T @ fit.jac)


def _around_least_squares(own: Problem, num: int, rng: np.random.Generator) -> Array:
    best, *_ = searched(own, 24, rng)
    normal = rng.multivariate_normal(best.x, 1.5 * covariance(best), num)
    return np.concatenate([normal, 3 * (normal[: num // 4] - best.x) + best.x])


def answer(own: Problem, *, num: int, final: int, seed: int) -> Answer:
    """Return the answer of a problem: a closed form, or long importance sampling.

    Args:
        own: The problem.
        num: Draws a round of the search for a proposal.
        final: Draws behind the answer.
        seed: Of all draws.
    """
    if own.closed_form is not None:
        return _known(*own.closed_form(own))
    rng = np.random.default_rng(seed)
    proposal = found_proposal(own, num, rng)
    sample = Weighted.drawn(own, proposal, final, rng)
    theta = own.to_theta(sample.u)
    label, weight = own.region(theta), sample.weight
    mean, cov = moments(theta, weight)
    return Answer(
        mean=mean,
        cov=cov,
        log_evidence=sample.log_evidence,
        error=sample.error,
        regions={
            int(k): Region(
                float(weight[label == k].sum()), *moments(theta, weight * (label == k))
            )
            for k in np.unique(label[weight > 0])
        },
        effective=sample.effective,
        proposal=proposal,
    )


def _known(mean: Array, cov: Array, log_evidence: float) -> Answer:
    """Return a closed form, of parameters that are coordinates."""
    one = Students(np.ones(1), mean[None], 1.1 * np.linalg.cholesky(cov)[None])
    regions = {0: Region(1.0, mean, cov)}
    return Answer(mean, cov, log_evidence, 0.0, regions, np.inf, one)


def moments(theta: Array, weight: Array) -> tuple[Array, Array]:
    """Return mean (d,) and covariance (d, d) of weighted parameters (n, d)."""
    weight = weight / weight.sum()
    mean = weight @ theta
    gap = theta - mean
    return mean, (weight[:, None] * gap).T @ gap


def write(answers: dict[str, Answer], path: Path = FILE) -> None:
    """Write answers with six digits, a problem a line."""
    kept = {name: _plain(a) for name, a in sorted(answers.items())}
    rows = (f"{json.dumps(k)}: {json.dumps(v)}" for k, v in kept.items())
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n")


def _plain(own: Answer) -> dict[str, Any]:
    regions = {k: vars(region) for k, region in own.regions.items()}
    return _rounded({**vars(own), "regions": regions, "proposal": vars(own.proposal)})


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    if isinstance(value, np.ndarray):
        return _rounded(value.tolist())
    return float(f"{value:.8g}")


@lru_cache
def answers(path: Path = FILE) -> dict[str, Answer]:
    """Return the committed answers by the name of their problem."""
    return {
        name: Answer(
            **_arrays(row, "regions", "proposal"),
            regions={int(k): Region(**_arrays(v)) for k, v in row["regions"].items()},
            proposal=Students(**_arrays(row["proposal"])),
        )
        for name, row in json.loads(path.read_text()).items()
    }


def _arrays(row: dict[str, Any], *without: str) -> dict[str, Any]:
    kept = {k: v for k, v in row.items() if k not in without}
    return {k: np.array(v) if isinstance(v, list) else v for k, v in kept.items()}
