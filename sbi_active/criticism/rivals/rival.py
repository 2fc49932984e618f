"""A rival: the simulator with some effects and a distribution of its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.results import ModelKey, Residuals
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import NoiseGrid, Whitener
from sbi_active.criticism.rivals.heavy_tails import signed_deviance
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.inference.sampling.weights import log_sum_exp

#: Probability that a trial has no outcome where the simulator has one, or vice versa.
DISAGREEMENT = 0.02
#: Rates where nothing declared explains the outcomes, equally likely.
UNKNOWN_RATES = (DISAGREEMENT, 0.1, 0.3, 0.5)


def log_outcomes(
    probability: Array, valid: Array, rates: Sequence[float] = (DISAGREEMENT,)
) -> Array:
    r"""Return the log probability of the trials' validity flags.

    .. math::
        \log \frac1R \sum_{\epsilon} \prod_t
        \bigl[(1 - \epsilon)\, q_t + \epsilon\, (1 - q_t)\bigr]

    less its value where all agree for sure, so that flags which say nothing count
    nothing, with :math:`q_t = P(v_t | \theta, \phi, \xi_t)` of the flag :math:`v_t`:
    0 or 1 from a deterministic simulator, the share of its draws from a random one.

    Args:
        probability: Probability of an outcome by the simulator, shape (n, t).
        valid: Mask of the trials that have one, shape (t,).
        rates: :math:`\epsilon`, the R probabilities of disagreement, equally likely.

    Returns:
        Shape (n,), nats.
    """
    q = np.where(valid, probability, 1 - probability)
    each = [np.log((1 - e) * q + e * (1 - q)).sum(-1) for e in rates]
    agreed = len(valid) * np.log1p(-DISAGREEMENT)
    return log_sum_exp(np.stack(each), axis=0) - np.log(len(rates)) - agreed


def surprising_outcomes(
    residuals: Residuals, rare: float = 0.05
) -> tuple[list[int], list[int]]:
    """Return places of trials whose validity the model holds for improbable.

    Args:
        residuals: Residuals with the probability of a measurement in each trial.
        rare: Probability of what happened below which it is improbable.

    Returns:
        Those without a measurement and those with one.
    """
    p = residuals.probability_valid
    if p is None:
        return [], []
    valid = np.isfinite(residuals.x.reshape(len(p), -1)).any(1)
    lost = np.flatnonzero(~valid & (1 - p < rare))
    kept = np.flatnonzero(valid & (p < rare))
    return lost.tolist(), kept.tolist()


STEP = 1e-3  # of finite differences, in deviations of the prior
#: Square that stands for the reference of a random simulator's deviations: a thirtieth
#: of it has a square above zero still.
LOG_SCALE = 1 + 2 * float(np.log(30.0))


@dataclass(eq=False, kw_only=True)
class Rival:
    r"""A model of the trials, :math:`p(x | z)\, p(z)` with z = (theta, phi).

    Attributes:
        key: Key of the rival.
        simulator: Simulator of the trials, shared by all rivals.
        prior: Prior of theta.
        effects: Effects that this rival has.
        nuisances: Effects of scope "trial", which every rival has.
        error: Distribution of the residual.
        spread: Deviation of the prior predictive, shape (N,), which is the density of a
            number where the simulator gives none.
        center: Mean of the prior predictive, shape (N,).
        step: Step of finite differences, in u.
        reference: Deviation of a random simulator's numbers, shape (N,), where it is
            part of a sum of squares; None leaves it to the likelihood.
        heavy: Degrees of freedom and deviation, shape (N,), of t errors where a sum of
            squares has their peaks; None leaves them to the likelihood.
        coordinates: Coordinates of z.
        num_trials: Number of trials.
        num_observed: Number of measured numbers of all trials.
    """

    key: ModelKey
    simulator: TrialSimulator
    prior: Distribution
    effects: Sequence[Effect]
    nuisances: Sequence[Effect]
    error: NoiseGrid | ResidualProcess
    spread: Array
    center: Array
    step: float = STEP
    reference: Array | None = None
    heavy: tuple[float, Array] | None = None

    def __post_init__(self) -> None:
        self.num_trials = len(self.simulator.trials)
        self.num_observed = len(self.simulator.measurements)
        self.coordinates = SearchCoordinates(
            self.prior, self.effects, self.nuisances, self.num_trials
        )

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return self.coordinates.dim

    @property
    def theta_dim(self) -> int:
        """Number of coordinates of the simulator's own parameters."""
        return int(self.prior.event_shape[0])

    @property
    def noise(self) -> NoiseGrid:
        """The error without a residual process, which no search has to follow."""
        return self.error if isinstance(self.error, NoiseGrid) else self.error.noise

    @property
    def searched(self) -> NDArray[np.bool_]:
        """Coordinates that a least-squares search may move: not those of the noise."""
        flags = np.ones(self.dim, dtype=bool)
        for effect in self.coordinates.joint.effects:
            flags[self.coordinates.places[effect.name]] = effect.hook != "noise"
        return flags

    def residual(
        self, u: Array, *, penalized: bool = True
    ) -> tuple[Array, Array, Array]:
        """Return residuals in units of the declared noise.

        Args:
            u: Coordinates, shape (n, dim).
            penalized: Where the simulator gives no number, a search needs a residual
                that drives it away: the spread of the prior predictive, in units of the
                noise. False gives what the likelihood has there, the prior predictive
                itself as the number's distribution.

        Returns:
            Observation minus prediction divided by the effects' factor on the noise,
            shape (n, N), or (n, 2 N) with what the deviations of a random simulator
            add to a sum of squares; log of these factors, shape (n, N), or (n, 1) of
            zeros without any; log probability of which trials have an outcome, (n,).
        """
        theta, phi = self.coordinates.split(u)
        mean, sd, probability = self.simulator.predict(theta, phi)
        m, missing = self.simulator.measurements, ~np.isfinite(mean)
        residual = np.where(missing, self.spread, m.x - mean)
        log_scale = np.zeros((len(u), 1))
        scale = self.simulator.noise_scale(phi, len(u))
        if sd is not None:
            sd = np.where(np.isfinite(sd), sd, self.spread)
            scale = sd if scale is None else scale * sd
        if missing.any() and not penalized:
            residual = np.where(missing, m.x - self.center, residual)
            wide = self.spread / self.error.typical_sd
            scale = np.where(missing, wide, 1.0 if scale is None else scale)
        if scale is not None:
            scale = np.maximum(scale, 1e-12)
            residual, log_scale = residual / scale, np.log(scale)
        flags = log_outcomes(probability, m.valid)
        residual = np.clip(residual, -1e100, 1e100)  # so that its square is finite
        if self.reference is not None:
            # Half of its square is the log of a deviation, but for a constant.
            square = LOG_SCALE + 2 * (log_scale - np.log(self.reference))
            residual = np.concatenate([residual, np.sqrt(np.maximum(square, 0))], 1)
        if self.heavy is not None and penalized:
            df, sd = self.heavy
            residual = sd * signed_deviance(residual / sd, df)
        return residual, log_scale, flags

    @property
    def num_simulations(self) -> int:
        """Trials simulated so far, for all rivals."""
        return self.simulator.num_simulations

    def sample_prior(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (num, dim)."""
        return self.coordinates.sample(num, seed=int(rng.integers(2**62)))

    def simulated(self, u: Array) -> Array:
        """Return the places (n, dim) that are within the prior."""
        return u[np.isfinite(self.log_prior(u))]

    def splits_off(self, axes: NDArray[np.bool_], rng: np.random.Generator) -> bool:
        """Return False: an effect that acts on no trial is a question of interest."""
        return False

    def whitener(self, u: Array | None = None) -> Whitener:
        """Return the whitener of residuals by the likeliest error at u, shape (1, dim).

        It is the same object if the error has nothing unknown, and without u.
        """
        if u is None or self.noise.is_known:
            return self.noise.start
        return self.noise.whitener(self.residual(u)[0][0])

    def log_likelihood(self, u: Array, *, floor: float | Array = -np.inf) -> Array:
        """Return log p(x | z), shape (n,); all trials are simulated at once."""
        if not len(u):
            return np.zeros(0)
        residual, log_scale, flags = self.residual(u, penalized=False)
        log_p = self.error.log_likelihood(residual) - log_scale.sum(1) + flags
        return np.where(np.isfinite(log_p), log_p, -np.inf)

    def log_prior(self, u: Array) -> Array:
        """Return log p(z) with respect to u, shape (n,)."""
        return self.coordinates.log_prob(u)

    def jacobian(
        self, u: Array, whiten: Whitener, step: float | Array
    ) -> tuple[Array, Array]:
        """Return whitened residuals and their derivatives by finite differences.

        Args:
            u: Coordinates, shape (n, dim).
            whiten: Whitener, which maps (..., N) to (..., N).
            step: Step in u, one or one a coordinate, shape (dim,). Where it would
                leave the bounds, it is taken to the other side.

        Returns:
            Shapes (n, N) and (n, N, dim).
        """
        c = self.coordinates
        step = np.broadcast_to(step, (self.dim,))
        groups = [g for g in c.groups() if self.searched[g > 0].any()]
        leaves = (u + step > c.high) | (u + step < c.low)
        sign = np.where(leaves, -1.0, 1.0)
        stack = [u, *[u + step * sign * g for g in groups]]
        points = np.concatenate(stack)
        all_r = whiten(self.residual(points)[0])
        r = all_r.reshape(len(stack), *u.shape[:1], -1)
        if self.simulator.failed:  # from where there is a number to where there is none
            seen = np.isfinite(self.simulator.predict(*c.split(points))[0])
            seen = np.resize(seen.T, (r.shape[-1], len(points))).T.reshape(r.shape)
            r[1:] = np.where(seen[1:] == seen[0], r[1:], r[0])
        trial_of, trial = c.trial_of(), self.simulator.measurements.trial
        trial = np.resize(trial, r.shape[-1])
        jac = np.zeros((*r[0].shape, self.dim))
        for k, group in enumerate(groups):
            change = (r[k + 1] - r[0]) / step[group > 0][0]
            for j in np.flatnonzero(group):
                own = (trial_of[j] < 0) | (trial == trial_of[j])
                jac[:, :, j] = np.where(own, sign[:, j, None] * change, 0.0)
        return r[0], jac
