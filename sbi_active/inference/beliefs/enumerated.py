"""Priors and beliefs some of whose parameters take a few values."""

from __future__ import annotations

import copy
import math
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from sbi.utils import MultipleIndependent
from torch import Tensor
from torch.distributions import Distribution, Independent
from typing_extensions import override

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.seeding import derive_seed
from sbi_active.simulation.model import SimulatorModel


@dataclass(frozen=True)
class Enumeration:
    """A prior as a mixture over the values of its discrete parameters.

    Attributes:
        places: Columns of theta that are discrete, shape (m,).
        values: Combinations of their values, shape (k, m).
        log_prob: Log prior probabilities, shape (k,).
        others: Columns of theta that are continuous, shape (d - m,).
        rest: Prior of these, independent of the discrete ones.
        most_values: Number of combinations at most: each has a posterior of its own.
            Half refuses seven switches, twice takes twice as long.
    """

    most_values: ClassVar[int] = 64
    places: Tensor
    values: Tensor
    log_prob: Tensor
    others: Tensor
    rest: Distribution

    @staticmethod
    def of(prior: Any) -> Enumeration | None:
        """Return the mixture; None of any other prior than independent parts.

        Some parts must be discrete with finitely many values, and others continuous.
        """
        if not isinstance(prior, MultipleIndependent):
            return None
        sizes = [int(size) for size in prior.dims_per_dist]
        columns = torch.arange(sum(sizes)).split(sizes)
        parts: list[Any] = [
            *zip(prior.dists, columns, map(_values, prior.dists), strict=True)
        ]
        chosen = [part for part in parts if part[2] is not None]
        rest = [part for part in parts if part[2] is None]
        axes = [own for _, at, own in chosen for _ in at]
        num = math.prod(len(own) for own in axes)
        if not (chosen and rest and num <= Enumeration.most_values):
            return None
        values = torch.cartesian_prod(*axes).reshape(num, -1)
        log_p = torch.zeros(num)
        own = values.split([len(at) for _, at, _ in chosen], 1)
        for (part, _, _), rows in zip(chosen, own, strict=True):
            log_p = log_p + part.log_prob(rows).reshape(num, -1).sum(1)
        joint, possible = rest[0][0], log_p > -torch.inf
        if len(rest) > 1:
            others = [part for part, _, _ in rest]
            joint = MultipleIndependent(others, validate_args=False)
        places, others = (torch.cat([at for _, at, _ in g]) for g in (chosen, rest))
        return Enumeration(places, values[possible], log_p[possible], others, joint)

    def filled(self, k: int, theta: Tensor) -> Tensor:
        """Return parameters (..., d) of continuous ones (..., d - m), combination k."""
        size = len(self.places) + len(self.others)
        full = theta.new_empty(*theta.shape[:-1], size)
        full[..., self.places] = self.values[k].to(theta)
        full[..., self.others] = theta
        return full

    def combination(self, theta: Tensor) -> Tensor:
        """Return the combination of each row (n, d), -1 where it has none, (n,)."""
        same = (theta[:, None, self.places] == self.values.to(theta)).all(-1)
        return torch.where(same.any(1), same.float().argmax(1), -1)


class EnumeratedBelief(Belief):
    r"""A mixture over the values of discrete parameters.

    .. math::
        b(\theta, v) = P(v)\, b_v(\theta), \qquad
        P(v) \propto p(v) \int p(\theta) \prod_k p(x_k | \theta, v, \xi_k)\, d\theta

    Args:
        prior: Original prior of all parameters.
        enumeration: The prior as a mixture.
        parts: Belief over the continuous parameters of each combination.
        probability: Probability of each combination, shape (k,).

    Attributes:
        values: Combinations of the discrete parameters, shape (k, m).
        probability: Posterior probabilities, shape (k,).
    """

    label = "enumerated"

    def __init__(
        self,
        prior: Distribution,
        enumeration: Enumeration,
        parts: Sequence[Belief],
        probability: Tensor,
    ) -> None:
        super().__init__(prior)
        self._enumeration, self.parts = enumeration, [*parts]
        self.values, self.probability = enumeration.values, probability.double()

    def _sample(self, num_samples: int) -> Tensor:
        return self._drawn(num_samples, "_sample")

    @override
    def _typical(self, num_samples: int) -> Tensor:
        return self._drawn(num_samples, "_typical")

    def _drawn(self, num_samples: int, kind: str) -> Tensor:
        which = torch.multinomial(self.probability, num_samples, replacement=True)
        drawn = torch.empty(num_samples, *self.event_shape)
        for k, part in enumerate(self.parts):
            rows = (which == k).nonzero()[:, 0]
            if len(rows):
                own = getattr(part, kind)(len(rows)).float()
                drawn[rows] = self._enumeration.filled(k, own)
        return drawn

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self._density(theta, Belief.log_prob)

    @override
    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        return self._density(theta, Belief.smooth_log_prob)

    def _density(self, theta: Tensor, log_prob: Callable[..., Tensor]) -> Tensor:
        which, own = self._enumeration.combination(theta), self._enumeration.others
        density = torch.full((len(theta),), -torch.inf, dtype=torch.float64)
        for k, part in enumerate(self.parts):
            rows = (which == k).nonzero()[:, 0]
            if len(rows):
                inside = log_prob(part, theta[rows][:, own]).double()
                density[rows] = self.probability[k].log() + inside
        return density


def _values(part: Any) -> Tensor | None:
    """Return the values that each number takes; None of infinitely many."""
    while isinstance(part, Independent):
        part = part.base_dist
    try:
        if not part.support.is_discrete or not part.has_enumerate_support:
            return None
        return part.enumerate_support(expand=False).flatten().float()
    except NotImplementedError:  # as of batches whose numbers take different values
        return None


class Filled:
    """A function of the continuous parameters, the discrete ones at one combination.

    Args:
        fn: ``fn(theta, action, ...)`` of all parameters, of rows or of one.
        enumeration: Which parameters are discrete.
        k: Number of the combination.
    """

    def __init__(
        self, fn: Callable[..., Any], enumeration: Enumeration, k: int
    ) -> None:
        self._fn, self._enumeration, self._k = fn, enumeration, k
        self.__wrapped__ = fn  # whose signature it has

    def __call__(self, theta: Any, *arguments: Any, **keywords: Any) -> Any:
        """Return what the function gives."""
        full = self._enumeration.filled(self._k, torch.as_tensor(theta))
        given = full.numpy() if isinstance(theta, np.ndarray) else full
        return self._fn(given, *arguments, **keywords)


def filled_simulator(simulator: Any, enumeration: Enumeration, k: int) -> Any:
    """Return a simulator of the continuous parameters alone, its noise as declared."""
    if not isinstance(simulator, SimulatorModel):
        return Filled(simulator, enumeration, k)
    twin = copy.copy(simulator)
    twin.fn = Filled(simulator.fn, enumeration, k)
    twin.parameter_names = None
    twin._token = uuid.uuid4().hex  # workers keep simulators by it
    return twin


def enumerated(
    refine: Callable[..., Any],
    simulator: Callable[..., Any],
    prior: Distribution,
    enumeration: Enumeration,
    seed: int,
) -> EnumeratedBelief:
    """Return the belief over all parameters: one of the others for each combination.

    Each is computed afresh; what was simulated for earlier trials is not kept.

    Args:
        refine: From a simulator of continuous parameters, their prior and ``seed=`` to
            their belief.
        simulator: Simulator of all parameters.
        prior: Original prior.
        enumeration: The prior as a mixture.
        seed: Seed of everything random.

    Raises:
        UnexplainedOutcomeError: If no combination explains the outcomes.
    """
    found: dict[int, Any] = {}
    fault = None
    for k in range(len(enumeration.values)):
        own = filled_simulator(simulator, enumeration, k)
        seeded = derive_seed(seed, "values", k)
        try:
            found[k] = refine(own, enumeration.rest, seed=seeded)
        except UnexplainedOutcomeError as error:
            fault = error
    if fault is not None and not found:
        raise fault
    kept, parts = [*found], [*found.values()]
    values, log_prob = enumeration.values[kept], enumeration.log_prob[kept]
    evidence = [part.log_evidence for part in parts]
    mass = log_prob.double() + torch.tensor(evidence, dtype=torch.float64)
    known = [part.diagnostics for part in parts]
    inflated = torch.tensor(["noise_inflation" in d.figures for d in known])
    if not bool(inflated.all()):
        # Trials contradict each other where the noise was inflated. Evidence under
        # wider noise is not comparable: trials rule these values out.
        mass[inflated] = -torch.inf
    some = replace(enumeration, values=values, log_prob=log_prob)
    belief = EnumeratedBelief(prior, some, parts, mass.softmax(0))
    belief.diagnostics = _diagnosed(belief, known, float(mass.logsumexp(0)))
    return belief


def _diagnosed(
    belief: EnumeratedBelief,
    known: Sequence[Diagnostics],
    log_evidence: float,
    *,
    negligible: float = 0.01,
) -> Diagnostics:
    """Return what is known of a mixture: the worst of the parts that count."""
    rows = [*zip(belief.values.tolist(), belief.probability.tolist(), strict=True)]
    count = [(v, d) for (v, p), d in zip(rows, known, strict=True) if p > negligible]
    effective = [d.effective_sample_size or 0.0 for _, d in count]
    texts = [
        f"where the discrete parameters are {v}: {text}"
        for v, d in count
        for text in d.warnings
    ]
    found = Diagnostics(
        trustworthy=all(d.trustworthy is not False for _, d in count),
        num_simulations=sum(d.num_simulations for d in known),
        num_missing=sum(d.num_missing for d in known),
        effective_sample_size=min(effective),
    )
    found = found.extended(
        log_evidence=log_evidence,
        probabilities=[{"values": v, "probability": p} for v, p in rows],
    )
    return found.warned(*texts)
