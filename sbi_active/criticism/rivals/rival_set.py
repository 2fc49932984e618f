"""All rivals over one set of trials, and their evidence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
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
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, Evidence, ModelKey
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import (
    LARGEST,
    NoiseCell,
    NoiseGrid,
    declared_noise,
    measurement_sds,
    sizes,
)
from sbi_active.criticism.rivals.fit import (
    NESTED,
    STEPS,
    THOROUGH,
    Fit,
    look_for_jumps,
    settings_of,
)
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import NUM_REPLICATES, TrialSimulator
from sbi_active.inference.engine import WeightedDraws, infer, search
from sbi_active.seeding import derive_seed
from sbi_active.simulation import SimulatorModel

#: Kept of a model, whose means are then known to a 20th of a deviation; and of the
#: prior, whose deviations are known to 5 % at a simulation of all trials.
NUM_DRAWS, NUM_BEFORE = 400, 200
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
        fits: Posteriors of rivals that are known.
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
    ) -> None:
        self.model, self.prior, self.trials, self.seed = model, prior, trials, seed
        self.actions, self.warm_up = actions, warm_up
        self.library = [e for e in effects if e.scope == "campaign"]
        self.effects = {e.name: e for e in self.library}
        self.nuisances = [e for e in effects if e.scope == "trial"]
        index = int(trials.index.max()) + 1
        augmented = AugmentedSimulator(model, effects, next_index=index)
        seed_of_trials = derive_seed(seed, "trials")
        self.simulator = TrialSimulator(augmented, trials, seed=seed_of_trials)
        self.measurements = self.simulator.measurements
        self._sizes: Sequence[Array] = ()
        self.noise = self.noise_of(self.measurements)
        self._predictives: dict[tuple[bytes | None, ...], tuple[Array, Array]] = {}
        self.fits: Mapping[ModelKey, Fit] = {}
        self.center, self.spread = self.prior_predictive(self.simulator)
        # Beyond a thousand deviations of the prior predictive a number is as far.
        reach = 1e3 * np.hypot(self.spread, self.noise.typical_sd)
        self.measurements = self.measurements.bounded(self.center, reach)
        self.simulator.measurements = self.measurements
        self.step, self.is_smooth = STEPS[0], True
        self.can_fail = not trials.valid.all() or self.simulator.failed
        self.step, self.is_smooth, self.roughness = look_for_jumps(
            self.rival(ModelKey()), seed=seed
        )
        if self.roughness.any():
            self.noise = self.noise.with_extra(self.roughness)

    def with_effects(self, names: Iterable[str]) -> RivalSet:
        """Return these models without other effects; their priors stay."""
        new = self.with_fits({})
        new.effects = {name: self.effects[name] for name in names}
        return new

    def with_fits(self, fits: Mapping[ModelKey, Fit]) -> RivalSet:
        """Return these models with posteriors of some of them."""
        new = copy(self)
        new.fits = fits
        return new

    def with_sizes(self, sizes: Sequence[Array]) -> RivalSet:
        """Return these models with errors of one of some sizes by channel, (c,)."""
        new = self.with_fits({})
        new._sizes = sizes
        vars(new).pop("_process", None)  # which has that noise
        new.noise = new.noise_of(new.measurements)
        if new.roughness.any():
            new.noise = new.noise.with_extra(new.roughness)
        return new

    def noise_of(self, measurements: Measurements) -> NoiseGrid:
        """Return the errors of some measurements."""
        seed = derive_seed(self.seed, "noise")
        noise = declared_noise(self.model.noise, measurements, seed=seed)
        if self._sizes:
            sizes = [np.maximum(size, 1e-300) for size in self._sizes]
            noise = noise.sized([size[measurements.channel] for size in sizes])
        return noise

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
            key=key,
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

    @property
    def sensor(self) -> NoiseGrid:
        """The sensor's error.

        What a simulator that jumps strays from any smooth function is part of it,
        unless ``measurement_sd`` says what it is. A random simulator has a deviation of
        its own.
        """
        m = self.measurements
        if (measured := measurement_sds(self.model.noise, m)) is not None:
            sd = np.broadcast_to(measured, len(m)).astype(float)
            return NoiseGrid([NoiseCell.of(m, sd=sd)])
        if self.model.noise is None:
            return self.noise.sized([self.typical_deviation()])
        return self.noise

    def _error_model(
        self, error: str | None, suspect: int | None
    ) -> NoiseGrid | ResidualProcess:
        if error == SCATTER:
            return self.noise.scaled(np.hypot(1, sizes(LARGEST)))
        if error == UNEXPLAINED:
            return self._process
        if error is None or suspect is None:
            return self.noise
        at = self.measurements.trial == suspect
        # With a thousand deviations of the noise a number tells next to nothing.
        return self.noise.with_extra(np.where(at, 1e3 * self.noise.typical_sd, 0.0))

    @property
    def has_known_noise(self) -> bool:
        """Whether errors are declared as Gaussian with nothing unknown."""
        noise = self.model.noise
        return noise is not None and noise.is_known_gaussian and self.noise.is_known

    @cached_property
    def _process(self) -> ResidualProcess:
        every = np.ones(len(self.measurements), dtype=bool)
        return self.residual_process(self.noise, every)

    def residual_process(
        self, noise: NoiseGrid, at: NDArray[np.bool_]
    ) -> ResidualProcess:
        """Return some numbers' noise with a smooth function of the action and time.

        Args:
            noise: Noise without it.
            at: Mask of the numbers, shape (N,).
        """
        return ResidualProcess(
            noise.part(at),
            self.measurements.part(at),
            action=self.scaled_actions(),
            order=self.scaled_order(),
            largest=float(np.median(self.spread / noise.typical_sd)),
            spread=None if self.simulator.is_stochastic else self.spread[at],
        )

    def scaled_actions(self, trials: Trials | None = None) -> Array:
        """Return actions in ranges of the action space, those of the fit first.

        Actions that are labels are so far from each other that a smooth function of
        them has another value at each.

        Args:
            trials: Further trials.
        """
        own = self.trials.action.numpy()
        action = own if trials is None else np.r_[own, trials.action.numpy()]
        if self.trials.action_is_label:  # which says nothing of how near trials are
            return 100.0 * action
        if self.actions is not None:
            draws = self.actions.sample((256,), seed=0).double().numpy()
            own = np.concatenate([draws, own])
        width = np.ptp(own, axis=0)
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

    def fit(self, key: ModelKey = ModelKey()) -> Fit:  # noqa: B008  (frozen)
        """Return one rival with its posterior: the known one, or a sample of it."""
        found = self.fits.get(key)
        return self.sampled(key) if found is None else found

    def sampled(self, key: ModelKey, near: Array | None = None) -> Fit:
        """Return one rival with a sample of its posterior and its evidence.

        Args:
            key: Key of the rival.
            near: Points from which its modes are searched beside draws of the prior,
                shape (k, dim).
        """
        rival, seed = self.rival(key), derive_seed(self.seed, "evidence", str(key))
        repeats = NUM_REPLICATES if self.simulator.is_stochastic else 1
        settings = settings_of(len(self.trials) * repeats, is_bare=key == ModelKey())
        rng = np.random.default_rng(derive_seed(self.seed, "search", str(key)))
        found = search(rival, rng, near, THOROUGH if near is None else NESTED)
        rng = np.random.default_rng(seed)
        sample = infer(rival, rng, found=found, settings=settings)
        if not len(sample.u):  # nothing has a likelihood
            u = rival.sample_prior(NUM_DRAWS, rng)
            equal = np.full(len(u), 1 / len(u))
            sample = replace(sample, u=u, weight=equal, log_likelihood=equal * -np.inf)
        drawn = sample.draws(NUM_DRAWS, np.random.default_rng(seed))
        return Fit(rival, sample, self.record(rival, sample, drawn))

    def record(self, rival: Rival, sample: WeightedDraws, u: Array) -> Evidence:
        """Return the record of a rival.

        Args:
            rival: The rival.
            sample: Sample of its posterior.
            u: Draws that are shown, shape (n, dim).
        """
        c, own = rival.coordinates, rival.coordinates.num_own
        return Evidence(
            key=rival.key,
            log_evidence=sample.log_evidence,
            standard_error=sample.standard_error,
            effective_sample_size=sample.effective_sample_size,
            engine=sample.method,
            names=self.names_of(rival),
            draws=c.to_z(u)[:, :own],
        )

    def names_of(self, rival: Rival) -> tuple[str, ...]:
        """Return the names of the parameters of a rival and its effects."""
        names = self.model.parameter_names
        if names is None:
            names = [f"theta_{i + 1}" for i in range(self.prior.event_shape[0])]
        return (*names, *[n for e in rival.effects for n in e.phi_names])

    @cached_property
    def prior_draws(self) -> Array:
        """Draws of the bare model's prior, shape (n, dim), which are simulated."""
        return self._prior_draws(len(self.trials))[1]

    def _prior_draws(self, num_trials: int) -> tuple[SearchCoordinates, Array]:
        c = SearchCoordinates(self.prior, (), self.nuisances, num_trials)
        return c, c.sample(NUM_BEFORE, seed=derive_seed(self.seed, "spread"))

    def typical_deviation(self) -> Array:
        """Return the deviation of a random simulator's numbers before the data, (N,).

        It is the geometric mean over draws of the prior.
        """
        split = self.rival(ModelKey()).coordinates.split(self.prior_draws)
        sd = self.simulator.predict(*split)[1]
        assert sd is not None  # it is random
        log_sd = np.log(np.where(np.isfinite(sd), sd, self.spread))
        return np.exp(log_sd.mean(0))

    def prior_predictive(self, simulator: TrialSimulator) -> tuple[Array, Array]:
        """Return mean and deviation of each number before the data, shapes (N,)."""
        trials = simulator.trials
        asked = (
            trials.action,
            trials.settings(),
            trials.index,
            trials.sample_times,
            trials.input_times,
            simulator.measurements.position,
        )
        key = tuple(None if a is None else np.asarray(a).tobytes() for a in asked)
        if key not in self._predictives:
            c, u = self._prior_draws(len(trials))
            self._predictives[key] = _moments(simulator.predict(*c.split(u))[0])
        return self._predictives[key]


def _moments(mean: Array) -> tuple[Array, Array]:
    """Return mean and deviation over draws (n, N) of each number, shapes (N,)."""
    finite = np.isfinite(mean).any(0)
    center, spread = np.zeros((2, mean.shape[1]))
    center[finite] = np.nanmean(mean[:, finite], axis=0)
    spread[finite] = np.nanstd(mean[:, finite], axis=0)
    typical = np.median(spread[spread > 0]) if (spread > 0).any() else 1.0
    if finite.any() and not finite.all():
        # No draw gives a number there: any that the others give is as good.
        center[~finite] = np.mean(center[finite])
        spread[~finite] = np.hypot(typical, np.std(center[finite]))
    return center, np.maximum(spread, 1e-3 * typical)
