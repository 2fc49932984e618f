"""All rivals over one set of trials, and their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.jumps import STEPS, look_for_jumps
from sbi_active.criticism.evidence.predicted_before import NUM_DRAWS as NUM_BEFORE
from sbi_active.criticism.evidence.predicted_before import predicted_before
from sbi_active.criticism.evidence.settings import (
    NESTED,
    ROUGH,
    THOROUGH,
    settings_of,
)
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, Evidence, ModelKey
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import ErrorModel, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import declared_noise, scattered
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import (
    NUM_REPLICATES,
    TrialSimulator,
)
from sbi_active.inference.engine import Found, WeightedDraws, infer, search
from sbi_active.inference.engine.search import SearchSettings
from sbi_active.seeding import derive_seed
from sbi_active.simulation import AutocorrelatedNoise, GaussianNoise, SimulatorModel

NUM_DRAWS = 400  # kept of a model; a mean is then known to a 20th of a deviation
#: Trials from which their order may be what residuals follow.
FEW_TRIALS = 5


class RivalSet:
    """The bare model, its extensions by effects, and the catch-alls.

    Args:
        model: The bare simulator.
        prior: Prior of its parameters.
        trials: Trials that may be fitted.
        effects: Declared effects; of scope "trial" ones every rival has.
        actions: The permitted ones, for the length scales of the residual process; None
            takes the range of the trials.
        seed: Seed of all draws.
        warm_up: Time from its first sample in which a trial that was not fitted tells
            of its nuisances, and is not scored.

    Attributes:
        effects: Effects of scope "campaign", by name.
        library: Effects that were declared, of which priors tell.
        noise: Distribution of the errors of the bare model.
        center: Mean of the prior predictive, shape (N,).
        spread: Deviation of the prior predictive, shape (N,).
        can_fail: Whether a trial, or one of the prior predictive, has no outcome.
        step: Step of finite differences.
        is_smooth: Whether derivatives mean anything.
        roughness: Deviation of what no smooth function of the parameters follows, which
            ``noise`` has on top of the declared one, shape (N,); 0 where it is smooth.
        fits: The rivals that were asked for.
        found: Modes of some that are not fitted yet.
    """

    def __init__(
        self,
        model: SimulatorModel,
        prior: Distribution,
        trials: Trials,
        effects: Sequence[Effect],
        *,
        actions: ActionSpace | None = None,
        seed: int = 0,
        warm_up: float = 0.0,
        # Deviations of the prior predictive beyond which a number counts as that far.
        farthest: float = 1e3,
    ) -> None:
        self.model, self.prior, self.trials, self.seed = model, prior, trials, seed
        self.actions = actions
        self.effects = {e.name: e for e in effects if e.scope == "campaign"}
        self.library = [*self.effects.values()]
        self.nuisances = [e for e in effects if e.scope == "trial"]
        index = int(trials.index.max()) + 1
        augmented = AugmentedSimulator(model, effects, next_index=index)
        seed_of_trials = derive_seed(seed, "trials")
        self.simulator = TrialSimulator(augmented, trials, seed=seed_of_trials)
        self.measurements = self.simulator.measurements
        self.warm_up = warm_up
        self._factors: tuple[Array, Array] | None = None
        self.noise = self.noise_of(self.measurements)
        self._predictives: dict[tuple[bytes | None, ...], tuple[Array, Array]] = {}
        self.center, self.spread = self.prior_predictive(self.simulator)
        reach = farthest * np.hypot(self.spread, self.noise.typical_sd)
        self.measurements = self.measurements.bounded(self.center, reach)
        self.simulator.measurements = self.measurements
        self.step, self.is_smooth = STEPS[0], True
        self.can_fail = not trials.valid.all() or self.simulator.failed
        self.step, self.is_smooth, self.roughness = look_for_jumps(
            self.rival(ModelKey()), seed=seed
        )
        if self.roughness.any():
            self.noise = self.noise.with_extra(self.roughness)
        self.fits: dict[ModelKey, Fit] = {}
        self.found: dict[ModelKey, Found] = {}

    def noise_of(self, measurements: Measurements) -> NoiseGrid:
        """Return the errors of some measurements."""
        seed = derive_seed(self.seed, "noise")
        noise = declared_noise(self.model.noise, measurements, seed=seed)
        return noise if self._factors is None else noise.scaled(*self._factors)

    def widen(self, largest: float, *, num_factors: int = 14) -> None:
        """Let errors be larger than declared, by an unknown factor.

        Args:
            largest: Largest value of the factor, which is log-uniform from one.
            num_factors: Factors on the declared noise where every model
                misses by more.
        """
        factors = np.geomspace(1.0, max(largest, 2.0), num_factors)
        weights = np.full(num_factors, -np.log(num_factors))
        self._factors = factors, weights
        self.noise = self.noise.scaled(factors, weights)

    def rival(
        self, key: ModelKey, *, suspect: int | None = None, **further: Any
    ) -> Rival:
        """Return the simulator with some effects and an error model.

        Args:
            key: Key of the rival.
            suspect: Place of the trial that a gross error is in; None without one.
            **further: Arguments of :class:`.Rival` for a sum of squares.
        """
        return Rival(
            key,
            simulator=self.simulator,
            prior=self.prior,
            effects=[self.effects[name] for name in key.effects],
            nuisances=self.nuisances,
            error=self._error_model(key.error, suspect),
            spread=self.spread,
            center=self.center,
            step=self.step,
            **further,
        )

    def _error_model(
        self,
        error: str | None,
        suspect: int | None,
        *,
        # Deviations of the noise that a gross error may have: it tells next to nothing.
        gross: float = 1e3,
    ) -> ErrorModel:
        if error == SCATTER:
            return scattered(self.noise)
        if error == UNEXPLAINED:
            return self.residual_process()
        if error is None or suspect is None:
            return self.noise
        at = self.measurements.trial == suspect
        return self.noise.with_extra(np.where(at, gross * self.noise.typical_sd, 0.0))

    @property
    def has_known_noise(self) -> bool:
        """Whether errors are declared as Gaussian with nothing unknown."""
        gaussian = isinstance(self.model.noise, GaussianNoise | AutocorrelatedNoise)
        return gaussian and self.noise.shape == (1, 1)

    def within(self, key: ModelKey, z: Array) -> Array:
        """Return draws of a model, (n, d), moved into the bounds of its prior."""
        return self.rival(key).coordinates.within(z)

    def residual_process(
        self, noise: NoiseGrid | None = None, at: NDArray[np.bool_] | None = None
    ) -> ResidualProcess:
        """Return the noise with a smooth function of the action and time.

        Args:
            noise: Noise without it; None takes that of the bare model, and keeps what
                is made of it.
            at: Mask of the numbers that it is of, shape (N,); None for all.
        """
        if noise is not None:
            every = np.ones(len(self.measurements), dtype=bool)
            return self._beside_process(noise, every if at is None else at)
        if not hasattr(self, "_process"):
            noise = self.noise.settled(self._bare_residual)
            self._process = self.residual_process(noise)
        return self._process

    def _beside_process(
        self, noise: NoiseGrid, at: NDArray[np.bool_]
    ) -> ResidualProcess:
        return ResidualProcess(
            noise if at.all() else noise.part(at),
            self.measurements.part(at),
            action=self.scaled_actions(),
            order=self.scaled_order(),
            largest=float(np.median(self.spread / noise.typical_sd)),
            spread=None if self.simulator.is_stochastic else self.spread[at],
        )

    def _bare_residual(self) -> Array:
        return self.rival(ModelKey()).residual(self.fit().likeliest)[0][0]

    def scaled_actions(
        self, trials: Trials | None = None, *, apart: float = 100.0
    ) -> Array:
        """Return actions in ranges of the action space, those of the fit first.

        Actions that are labels are so far from each other that a smooth function of
        them has another value at each.

        Args:
            trials: Further trials.
            apart: Ranges of the action space between two trials whose
                actions are labels.
        """
        if self.trials.action_is_label:  # which says nothing of how near trials are
            parts = [self.trials, *([] if trials is None else [trials])]
            labels = np.concatenate([part.action.numpy() for part in parts])
            return labels * apart
        action = some = self.trials.action.numpy()
        if self.actions is not None:
            draws = self.actions.sample((256,), seed=0).double().numpy()
            some = np.concatenate([draws, action])
        width = np.ptp(some, axis=0)
        if trials is not None:
            action = np.concatenate([action, trials.action.numpy()])
        return action / np.where(width > 0, width, 1.0)

    def scaled_order(self, trials: Trials | None = None) -> Array | None:
        """Return the order of trials in the span of the fit; None if it has none.

        The order of a few trials is no structure: any differences between them follow
        it. Nor is an order that is not that of execution.

        Args:
            trials: Further trials.
        """
        index = own = self.trials.index.double().numpy()
        if trials is not None:
            index = np.concatenate([own, trials.index.double().numpy()])
        span = np.ptp(own)
        if span == 0 or len(own) < FEW_TRIALS or self.trials.order == "unknown":
            return None
        return (index - own.min()) / span

    def fit(
        self,
        key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
        near: Array | None = None,
    ) -> Fit:
        """Return one rival with its posterior and evidence, computed once.

        Args:
            key: Key of the rival.
            near: Points from which its modes are searched, shape (k, dim); None
                searches from many draws of the prior.
        """
        if key not in self.fits:
            rival, seed = self.rival(key), derive_seed(self.seed, "evidence", str(key))
            rng = np.random.default_rng(seed)
            found = self.found.pop(key, None) or self.search(key, near)
            sample = self._inferred(rival, found, rng)
            self.fits[key] = self._record(rival, sample, seed)
        return self.fits[key]

    def search(self, key: ModelKey, near: Array | None = None) -> Found:
        """Return the modes of a rival, see :meth:`fit`."""
        rival, seed = self.rival(key), derive_seed(self.seed, "search", str(key))
        how = THOROUGH if near is None else NESTED
        how = how if self.is_smooth else ROUGH
        return _searched(rival, near, how, seed)

    def _inferred(
        self, rival: Rival, found: Found, rng: np.random.Generator
    ) -> WeightedDraws:
        is_bare = rival.key == ModelKey()
        repeats = NUM_REPLICATES if self.simulator.is_stochastic else 1
        settings = settings_of(len(self.trials) * repeats, is_bare=is_bare)
        fit = infer(rival, rng, found=found, settings=settings)
        if len(fit.u):
            return fit
        u = rival.sample_prior(NUM_DRAWS, rng)  # nothing has a likelihood
        equal = np.full(len(u), 1 / len(u))
        return replace(fit, u=u, weight=equal, log_likelihood=equal * -np.inf)

    def _record(
        self,
        rival: Rival,
        sample: WeightedDraws,
        seed: int,
        *,
        # Draws of largest weight, among which the best fit is sought.
        num_top: int = 20,
    ) -> Fit:
        u = sample.draws(NUM_DRAWS, np.random.default_rng(seed))
        best = sample.u[np.argsort(sample.weight)[-num_top:]]
        own = sum(rival.coordinates.joint.sizes)
        residual = rival.residual(best, penalized=False)[0]
        square = [(rival.error.whitener(r)(r) ** 2).sum() for r in residual]
        evidence = Evidence(
            key=rival.key,
            log_evidence=sample.log_evidence,
            standard_error=sample.standard_error,
            effective_sample_size=sample.effective_sample_size,
            engine=sample.method,
            names=self.names_of(rival),
            draws=rival.coordinates.to_z(u)[:, :own],
            best_chi_square=float(min(square)),
        )
        return Fit(rival, sample, evidence)

    def names_of(self, rival: Rival) -> tuple[str, ...]:
        """Return the names of the parameters of a rival and its effects."""
        names = self.model.parameter_names
        if names is None:
            names = [f"theta_{i + 1}" for i in range(self.prior.event_shape[0])]
        return (*names, *[n for e in rival.effects for n in e.phi_names])

    def typical_deviation(self) -> Array:
        """Return the deviation of a random simulator's numbers before the data, (N,).

        It is the geometric mean over draws of the prior.
        """
        c = self.rival(ModelKey()).coordinates
        u = c.sample(NUM_BEFORE, seed=derive_seed(self.seed, "spread"))
        sd = self.simulator.predict(*c.split(u))[1]
        assert sd is not None  # it is random
        log_sd = np.log(np.where(np.isfinite(sd), sd, self.spread))
        return np.exp(log_sd.mean(0))

    def prior_predictive(self, simulator: TrialSimulator) -> tuple[Array, Array]:
        """Return mean and deviation of each number before the data, shapes (N,)."""
        m = simulator.measurements
        trials = simulator.trials
        asked = (
            trials.action,
            trials.settings(),
            trials.index,
            trials.sample_times,
            trials.input_times,
            m.position,
        )
        key = tuple(None if a is None else np.asarray(a).tobytes() for a in asked)
        if key not in self._predictives:
            seed = derive_seed(self.seed, "spread")
            c = SearchCoordinates(self.prior, (), self.nuisances, len(trials))
            self._predictives[key] = predicted_before(simulator, c, seed=seed)
        return self._predictives[key]


def _searched(
    rival: Rival, near: Array | None, how: SearchSettings, seed: int
) -> Found:
    found = search(rival, np.random.default_rng(seed), near, how)
    assert found is not None  # residuals are bounded
    return found
