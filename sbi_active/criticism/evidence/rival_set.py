"""All rivals over one set of trials, and their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.fit import FirstLook, Fit
from sbi_active.criticism.evidence.importance import (
    ENOUGH,
    MAX_ROUNDS,
    ImportanceSample,
    importance_sample,
)
from sbi_active.criticism.evidence.jumps import look_for_jumps
from sbi_active.criticism.evidence.laplace import laplace_sample
from sbi_active.criticism.evidence.least_squares import Modes
from sbi_active.criticism.evidence.outliers import OneOutlier
from sbi_active.criticism.evidence.predicted_before import predicted_before
from sbi_active.criticism.evidence.proposals import regressions, ridges
from sbi_active.criticism.evidence.searches import search
from sbi_active.criticism.evidence.tempering import temper
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, Evidence, ModelKey
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import ErrorModel, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import declared_noise, scattered
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.rivals.validity import DISAGREEMENT, UNKNOWN_RATES
from sbi_active.seeding import derive_seed
from sbi_active.simulation import AutocorrelatedNoise, GaussianNoise, SimulatorModel

Array = NDArray[Any]

NUM_DRAWS = 400  # kept of a model; a mean is then known to a 20th of a deviation
#: Trials from which their order may be what residuals follow.
FEW_TRIALS = 5
#: Below this effective sample size importance sampling is not trusted.
TOO_FEW = 20.0
#: Nats of a largest likelihood below another's evidence: its own need not be precise.
HOPELESS = 30.0
#: Nats by which Laplace's evidence stays below another's, so that nobody samples.
FAR_BEHIND = 10.0
#: The same, so that its evidence is worth no tempering.
UNLIKELY = 10.0
#: Particles and moves of the first cross-check by tempering, and the standard errors
#: by which it may exceed the evidence before the full number runs.
FEW_PARTICLES, FEW_MOVES, TOLERATED = 50, 2, 2.0
#: Nats by which an evidence is behind another, so that it need not be precise.
BEHIND = 5.0
#: The same where each trial has its own unknowns, among which particles are dear.
SETTLED = 3.0
#: Effective sample size that is enough where the simulator jumps, and the one below
#: which importance sampling is not trusted there: tempering, which climbs over the same
#: jumps, would have to do better.
ENOUGH_ROUGH, TOO_FEW_ROUGH = 30.0, 8.0
#: Factors on the declared noise where every model misses by more.
NUM_FACTORS = 14
#: Ranges of the action space between two trials whose actions are labels.
APART = 100.0
#: Deviations of the prior predictive beyond which a number counts as that far.
FARTHEST = 1e3
#: Draws of largest weight, among which the best fit is sought.
NUM_TOP = 20


class RivalSet:
    """The bare model, its extensions by effects, and the catch-alls.

    Args:
        model: The bare simulator.
        prior: Of its parameters.
        trials: Those that may be fitted.
        effects: Declared effects; of scope "trial" ones every rival has.
        actions: The permitted ones, for the length scales of the residual process; None
            takes the range of the trials.
        seed: Of all draws.
        reference: Log evidence of a model outside the set that these compete with.

    Attributes:
        effects: Effects of scope "campaign", by name.
        library: Those that were declared, of which priors tell.
        noise: Distribution of the errors of the bare model.
        center: Mean of the prior predictive, shape (N,).
        spread: Its deviation, shape (N,).
        can_fail: Whether a trial, or one of the prior predictive, has no outcome.
        step: Of finite differences.
        is_smooth: Whether derivatives mean anything.
        roughness: Deviation of what no smooth function of the parameters follows, which
            ``noise`` has on top of the declared one, shape (N,); 0 where it is smooth.
        fits: The rivals that were asked for.
        modes: Of some that are not fitted yet.
        look: What least squares found before; None where nobody looked.
        warm_up: Time from its first sample in which a trial that was not fitted tells
            of its nuisances, and is not scored.
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
        reference: float = -np.inf,
    ) -> None:
        self.reference = reference
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
        self.look: FirstLook | None = None
        self.warm_up = 0.0
        self._factors: tuple[Array, Array] | None = None
        self.noise = self.noise_of(self.measurements)
        self._predictives: dict[tuple[bytes | None, ...], tuple[Array, Array]] = {}
        self.center, self.spread = self.prior_predictive(self.simulator)
        reach = FARTHEST * np.hypot(self.spread, self.noise.typical_sd)
        self.measurements = self.measurements.bounded(self.center, reach)
        self.simulator.measurements = self.measurements
        self.can_fail = not trials.valid.all() or self.simulator.failed
        self.step, self.is_smooth, self.roughness = look_for_jumps(
            self.rival(ModelKey()), seed=seed
        )
        if self.roughness.any():
            self.noise = self.noise.with_extra(self.roughness)
        self.fits: dict[ModelKey, Fit] = {}
        self.modes: dict[ModelKey, Modes] = {}

    def noise_of(self, measurements: Measurements) -> NoiseGrid:
        """Return the errors of some measurements."""
        seed = derive_seed(self.seed, "noise")
        noise = declared_noise(self.model.noise, measurements, seed=seed)
        return noise if self._factors is None else noise.scaled(*self._factors)

    def widen(self, largest: float) -> None:
        """Let errors be larger than declared, by an unknown factor.

        Args:
            largest: Of the factor, which is log-uniform from one.
        """
        factors = np.geomspace(1.0, max(largest, 2.0), NUM_FACTORS)
        weights = np.full(NUM_FACTORS, -np.log(NUM_FACTORS))
        self._factors = factors, weights
        self.noise = self.noise.scaled(factors, weights)

    def rival(self, key: ModelKey) -> Rival:
        """Return the simulator with some effects and an error model."""
        return Rival(
            key,
            simulator=self.simulator,
            prior=self.prior,
            effects=[self.effects[name] for name in key.effects],
            nuisances=self.nuisances,
            error=self._error_model(key.error),
            spread=self.spread,
            center=self.center,
            disagreement=(
                UNKNOWN_RATES
                if key.error == UNEXPLAINED and self.can_fail
                else (DISAGREEMENT,)
            ),
        )

    def _error_model(self, error: str | None) -> ErrorModel:
        if error == SCATTER:
            return scattered(self.noise)
        if error == UNEXPLAINED:
            return self.residual_process()
        return self.noise if error is None else self.one_outlier()

    def one_outlier(self) -> OneOutlier:
        """Return the noise with a gross error in one trial."""
        if not hasattr(self, "_outlier"):
            noise = self.noise.settled(self._bare_residual)
            off = np.abs(self.measurements.x - self.center) / noise.typical_sd
            self._outlier = OneOutlier(noise, self.measurements, largest=off.max())
        return self._outlier

    @property
    def has_known_noise(self) -> bool:
        """Whether errors are declared as Gaussian with nothing unknown."""
        gaussian = isinstance(self.model.noise, GaussianNoise | AutocorrelatedNoise)
        return gaussian and self.noise.shape == (1, 1)

    def residual_process(self) -> ResidualProcess:
        """Return the noise with a smooth function of the action and time."""
        if not hasattr(self, "_process"):
            noise = self.noise.settled(self._bare_residual)
            self._process = ResidualProcess(
                noise,
                self.measurements,
                action=self.scaled_actions(),
                order=self.scaled_order(),
                largest=float(np.median(self.spread / noise.typical_sd)),
                spread=None if self.simulator.is_stochastic else self.spread,
            )
        return self._process

    def _bare_residual(self) -> Array:
        return self.rival(ModelKey()).residual(self.fit().likeliest)[0][0]

    def scaled_actions(self, trials: Trials | None = None) -> Array:
        """Return actions in ranges of the action space, those of the fit first.

        Those that are labels are so far from each other that a smooth function of them
        has another value at each.

        Args:
            trials: Further trials.
        """
        if self.trials.action_is_label:  # which says nothing of how near trials are
            parts = [self.trials, *([] if trials is None else [trials])]
            labels = np.concatenate([part.action.numpy() for part in parts])
            return labels * APART
        action = some = self.trials.action.numpy()
        if self.actions is not None:
            draws = self.actions.sample((256,), seed=0).double().numpy()
            some = np.concatenate([draws, action])
        width = np.ptp(some, axis=0)
        if trials is not None:
            action = np.concatenate([action, trials.action.numpy()])
        return action / np.where(width > 0, width, 1.0)

    def scaled_order(self, trials: Trials | None = None) -> Array | None:
        """Return the order of trials in the span of the fit; None where it has none.

        Among a few trials it is no structure: any differences of theirs follow it. Nor
        is one that is not that of execution.

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
        """Return one rival with its posterior and evidence, computed once."""
        if key not in self.fits:
            rival, seed = self.rival(key), derive_seed(self.seed, "evidence", str(key))
            before = self.simulator.num_simulations
            sample, engine = self._estimate(rival, seed)
            self.fits[key] = self._record(rival, sample, engine, before, seed)
        return self.fits[key]

    def tempered(self, key: ModelKey = ModelKey()) -> Evidence:  # noqa: B008
        """Return the evidence by tempering, and keep it where it is the larger.

        A mode that the least-squares search missed is missing from its evidence, and
        no effective sample size shows it. A few particles do the check; where they say
        more than the evidence, the full number decides.
        """
        rival, own = self.fit(key).rival, self.fit(key).evidence
        seed = derive_seed(self.seed, "tempering", str(key))
        before = self.simulator.num_simulations
        sample = self._temper(rival, seed, few=True)
        either = np.hypot(own.standard_error, sample.standard_error)
        if not sample.log_evidence < own.log_evidence + TOLERATED * either:
            sample = self._temper(rival, seed, few=False)
        other = self._record(rival, sample, "tempering", before, seed)
        both = float(np.hypot(own.standard_error, sample.standard_error))
        if sample.log_evidence > own.log_evidence + 2 * both:
            self.fits[key] = other
        return other.evidence

    def search(self, key: ModelKey) -> Modes:
        """Return the modes of a rival, from where smaller ones ended."""
        rival, seed = self.rival(key), derive_seed(self.seed, "evidence", str(key))
        return search(rival, self.fits, self.step, self.is_smooth, seed=seed)

    def _estimate(self, rival: Rival, seed: int) -> tuple[ImportanceSample, str]:
        modes = self.modes.pop(rival.key, None) or self.search(rival.key)
        rng = np.random.default_rng(seed)
        behind, best = self._behind(rival, modes.u), self._best_evidence()
        if self.is_smooth and rival.key != ModelKey() and behind > 0:
            sample = laplace_sample(rival, modes, rng)
            if -np.inf < sample.log_evidence < best - FAR_BEHIND:
                return sample, "linear"
        better, enough, too_few = ridges, ENOUGH, TOO_FEW
        given_up = best - HOPELESS if self.nuisances else -np.inf
        options: dict[str, Any] = {"dismissed": best - BEHIND, "hopeless": given_up}
        if not self.is_smooth:
            better, enough, too_few = regressions, ENOUGH_ROUGH, TOO_FEW_ROUGH
            options |= {"looks": range(MAX_ROUNDS), "missed": np.inf}
        sample = importance_sample(
            rival,
            modes.proposal,
            rng=rng,
            local=better(rival, modes, self.step, rng),
            enough=1.0 if behind > HOPELESS else enough,
            **options,
        )
        if not behind < UNLIKELY or sample.effective_sample_size >= too_few:
            return sample, "least squares"
        most = sample.log_evidence + TOLERATED * sample.standard_error
        if self.nuisances and most < best - SETTLED:
            return sample, "least squares"
        # All particles are dear here, and most often behind.
        for few in (True, False) if self.nuisances or not self.is_smooth else (False,):
            other = self._temper(rival, seed, few=few)
            both = np.hypot(sample.standard_error, other.standard_error)
            if sample.log_evidence - 2 * both > other.log_evidence:
                # Particles that lost a ridge do not find it again.
                return sample, "least squares"
        return other, "tempering"

    def _temper(self, rival: Rival, seed: int, *, few: bool) -> ImportanceSample:
        size = {"num_particles": FEW_PARTICLES, "num_moves": FEW_MOVES} if few else {}
        return temper(rival, seed=seed, **size)

    def _behind(self, rival: Rival, modes: Array) -> float:
        """Return how far even the largest likelihood is below a known evidence, nats.

        An evidence is an average of likelihoods.
        """
        if rival.has_noise_effect:  # whose coordinates the search leaves alone
            return -np.inf
        return self._best_evidence() - float(rival.log_likelihood(modes).max())

    def _best_evidence(self) -> float:
        """Return the largest log evidence so far."""
        known = [fit.evidence.log_evidence for fit in self.fits.values()]
        return float(max([*known, self.reference]))

    def _record(
        self,
        rival: Rival,
        sample: ImportanceSample,
        engine: str,
        before: int,
        seed: int,
    ) -> Fit:
        u = sample.draws(NUM_DRAWS, np.random.default_rng(seed))
        best = sample.u[np.argsort(sample.weights)[-NUM_TOP:]]
        if engine == "linear":
            best = sample.u[:1]  # its mode, before draws that nobody simulated
        own = sum(rival.coordinates.joint.sizes)
        residual = rival.residual(best, penalized=False)[0]
        square = [(rival.error.whitener(r)(r) ** 2).sum() for r in residual]
        evidence = Evidence(
            key=rival.key,
            log_evidence=sample.log_evidence,
            standard_error=sample.standard_error,
            effective_sample_size=sample.effective_sample_size,
            engine=engine,
            num_simulations=self.simulator.num_simulations - before,
            names=self.names_of(rival),
            draws=rival.coordinates.to_z(u)[:, :own],
            best_chi_square=float(min(square)),
        )
        return Fit(rival, sample, evidence)

    def names_of(self, rival: Rival) -> tuple[str, ...]:
        """Return what the parameters of a rival and its effects are called."""
        names = self.model.parameter_names
        if names is None:
            names = [f"theta_{i + 1}" for i in range(self.prior.event_shape[0])]
        return (*names, *[n for e in rival.effects for n in e.phi_names])

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
