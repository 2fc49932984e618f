r"""States of the error that all models share, and the evidence of a model in each.

.. math::
    p(x \mid m) = \sum_s P(s)\, Z_s(m)

The error is the sensor's alone; or beside it a residual process in all trials, which is
what nobody declared ("unexplained"); or larger than declared ("scatter"); or there is a
process in one trial alone, whichever it is, which is a gross error ("outlier"); or it
is what an effect on the noise makes of it. The same states for every model: whether an
effect is there is one question, and what its error is like another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.linear.fits import refitted
from sbi_active.criticism.linear.left_out import Candidate
from sbi_active.criticism.linear.mixture import WIDTHS, Mixture, summed
from sbi_active.criticism.linear.model import centered, linearize
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import OUTLIER, SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.rivals.rival import (
    DISAGREEMENT,
    UNKNOWN_RATES,
    log_outcomes,
)
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.support import support_bounds, support_of


@dataclass
class States:
    """Evidence of linear models in each state of the error.

    Attributes:
        search: Search that fits the models.
        chance: Probability of each state that is not the sensor's alone.
        passes: Tail probability of a chi-square from which a model fits to the sensor.
        fewest: Trials below which none can be told to have a gross error: two that
            agree outvote one.
        num_louder: Draws of effects on the noise, over which their evidence is a mean.
        num_outcomes: Posterior draws that tell which trials have an outcome, where the
            simulator may have none; the rate of one is then known to a tenth.
    """

    search: Search
    chance: float
    passes: float
    fewest: int = 3
    num_louder: int = 200
    num_outcomes: int = 64
    _known: dict[ModelKey, Mixture] = field(default_factory=dict)
    _aside: dict[ModelKey, Candidate] = field(default_factory=dict)
    _valid: dict[ModelKey, Array] = field(default_factory=dict)

    def keys(self, key: ModelKey) -> dict[ModelKey, float]:
        """Return a model in each state, and the state's log probability.

        Args:
            key: Effects on the prediction; the first state is the sensor's alone.
        """
        errors, effects = [UNEXPLAINED, SCATTER], self.search.rivals.effects
        if len(self.search.errors.trials) >= self.fewest:
            errors.append(OUTLIER)
        states = {ModelKey(key.effects, e): np.log(self.chance) for e in errors}
        for name, effect in effects.items():
            if effect.hook == "noise":
                both = tuple(n for n in effects if n in (*key.effects, name))
                states[ModelKey(both)] = self.search.prior[name]
        rest = 1 - np.exp([*states.values()]).sum()
        return {key: float(np.log(rest)), **states}

    def joint(
        self, key: ModelKey, use: NDArray[np.bool_] | None = None
    ) -> dict[ModelKey, float]:
        """Return a model in each state, and the log evidence of both, nats.

        Args:
            key: Effects on the prediction.
            use: Parts of the trials that count, shape (f,); None takes all. Of some
                trajectories, smooth functions of the action are no state.
        """
        return {
            own: p + self.mixture(own, use).log_evidence
            for own, p in self.keys(key).items()
        }

    def share(self, key: ModelKey) -> dict[ModelKey, float]:
        """Return a model in each state, and the state's probability given the model."""
        log_p = self.joint(key)
        total = log_sum_exp(np.array([*log_p.values()]))
        return {k: float(np.exp(p - total)) for k, p in log_p.items()}

    def likeliest(self, key: ModelKey) -> ModelKey:
        """Return a model in its most probable state."""
        log_p = self.joint(key)
        return max(log_p, key=log_p.__getitem__)

    def log_evidence(self, key: ModelKey) -> float:
        """Return the log evidence of a model in one state, nats."""
        return self.mixture(key).log_evidence

    def mixture(self, key: ModelKey, use: NDArray[np.bool_] | None = None) -> Mixture:
        """Return the posterior of a model in one state.

        Args:
            key: Effects, and the state of the error.
            use: Parts of the trials that count, shape (f,); None takes all.
        """
        if use is not None:
            return self._summed(key, use)
        if key not in self._known:
            self._known[key] = self._summed(key, None)
        return self._known[key]

    def _summed(self, key: ModelKey, use: NDArray[np.bool_] | None) -> Mixture:
        c, errors = self.candidate(key), self.search.errors
        some = np.ones(errors.num_folds, bool) if use is None else use
        gram, log_p = errors.hypotheses(c.model, c.grams, some, key.error)
        timed = self.search.rivals.measurements.is_sequence
        is_declared = timed and self.search.sensor.has_size
        if key.error == UNEXPLAINED and not is_declared:
            # Errors of their own are scatter; what differs by trial is not.
            own = slice(errors.num_processes, None)
            gram, log_p = gram[own], log_p[own]
            if use is None or not timed:  # it is dear along trajectories
                smooth = self.search.smooth(c.model, some)
                gram = np.concatenate([gram, smooth[0]])
                log_p = np.concatenate([log_p, smooth[1]])
        elif key.error is None and (louder := self.louder(key)):
            scale = self._scales(louder)[1]
            gram, log_p = errors.scaled(c.model, scale, some)
        log_p = log_p + self._beside_numbers(c, key.error, some)
        return summed(gram, log_p, c.model)

    def candidate(self, key: ModelKey) -> Candidate:
        """Return the fitted model that the evidence of a state rests on.

        Where a trial has a gross error it is linearized at the fit to the others: the
        fit to all may lie where the simulator has another slope. Models with effects
        are, if such an error is the likeliest state of the bare model.

        Args:
            key: Effects, and the state of the error.
        """
        own = self.search.found[self.predicting(key)]
        if key.error != OUTLIER or own.model.chi_square[2] >= self.passes:
            return own
        if key.effects and self.likeliest(ModelKey()).error != OUTLIER:
            return own
        if own.model.key not in self._aside:
            self._aside[own.model.key] = self._set_aside(own)
        return self._aside[own.model.key]

    def _set_aside(self, own: Candidate) -> Candidate:
        """Return a model linearized at its fit without a trial.

        The trial that the linear model holds to be the one is set aside, or that which
        errs most, whichever explains the trials better.

        Args:
            own: The model at its fit to all trials.
        """
        errors, found = self.search.errors, []
        every = np.ones(errors.num_folds, bool)
        for trial in self._suspects(own):
            c = self._without(own, trial)
            gram, log_p = errors.hypotheses(c.model, c.grams, every, OUTLIER)
            found.append((summed(gram, log_p, c.model).log_evidence, c))
        return max(found, key=lambda pair: pair[0])[1]

    def _without(self, own: Candidate, trial: int) -> Candidate:
        """Return a model linearized at its best fit to all but one trial.

        It begins where the bare model's is, and that at draws of its prior as well.

        Args:
            own: The model at its fit to all of them.
            trial: Place of the trial among those with a measurement.
        """
        search, key = self.search, own.model.key
        rival, m, units = search.rival(key), search.errors.measurements, search.units
        kept = m.trial != np.unique(m.trial)[trial]
        near = own.model.u[None].copy()
        if key.effects:
            bare = self.candidate(ModelKey(error=OUTLIER)).model
            near[:, search.columns(key, ModelKey())] = bare.u
        else:
            u, some = search.rivals.prior_draws, np.resize(kept, len(units))
            square = ((rival.residual(u)[0] / units)[:, some] ** 2).sum(1)
            near = u[np.argsort(square)[: search.settings.num_kept]]
        u = refitted(rival, own.model, units, kept, near)
        model = centered(rival, linearize(rival, u, units), units)
        return replace(own, model=model, grams=search.errors.grams(model))

    def _suspects(self, own: Candidate) -> list[int]:
        """Return the trials that may have a gross error by a fit to all of them."""
        errors = self.search.errors
        every = np.ones(errors.num_folds, bool)
        gram, log_p = errors.hypotheses(own.model, own.grams, every, OUTLIER)
        likeliest = self._by_trial(summed(gram, log_p, own.model)).argmax()
        _, trial = np.unique(errors.measurements.trial, return_inverse=True)
        square = own.model.residual[: own.model.num] ** 2
        worst = (np.bincount(trial, square) / np.bincount(trial)).argmax()
        return sorted({int(likeliest), int(worst)})

    def _by_trial(self, beside: Mixture) -> Array:
        """Return the probability that each trial has the gross error, shape (t,)."""
        return beside.share.reshape(len(self.search.errors.trials), -1).sum(1)

    def _beside_numbers(
        self, c: Candidate, error: str | None, use: NDArray[np.bool_]
    ) -> float:
        """Return what Gaussian residuals do not say of a model, nats.

        Log densities of its numbers at the best fit, and where the simulator may have
        no outcome the mean probability of which trials have one.

        Args:
            c: Fitted model.
            error: State of the error.
            use: Parts of the trials that count, shape (f,).
        """
        errors, rivals = self.search.errors, self.search.rivals
        found = float(c.model.offset[use[errors.fold]].sum())
        if not rivals.can_fail:
            return found
        measured = np.unique(rivals.measurements.trial)
        counts = np.ones(len(rivals.trials), bool)
        counts[measured] = [bool((own & use).any()) for own in errors.trials]
        valid = rivals.measurements.valid[counts]
        rates = UNKNOWN_RATES if error == UNEXPLAINED else (DISAGREEMENT,)
        log_p = log_outcomes(self._outcomes(c)[:, counts], valid, rates)
        return found + float(log_sum_exp(log_p) - np.log(len(log_p)))

    def _outcomes(self, c: Candidate) -> Array:
        """Return the probability that each trial has an outcome, by posterior draws."""
        key, rivals = c.model.key, self.search.rivals
        if key not in self._valid:
            own = max(c.sensor, c.beside, key=lambda m: m.log_evidence)
            rng = np.random.default_rng(derive_seed(rivals.seed, "outcomes", str(key)))
            u = c.model.draws(own.mean, own.cov, self.num_outcomes, rng)
            split = rivals.rival(key).coordinates.split(u)
            self._valid[key] = rivals.simulator.predict(*split)[2]
        return self._valid[key]

    def predicting(self, key: ModelKey) -> ModelKey:
        """Return the effects of a set that change the prediction."""
        return ModelKey(tuple(n for n in key.effects if n in self.search.names))

    def louder(self, key: ModelKey) -> list[Effect]:
        """Return the effects of a set that act on the noise alone."""
        effects = [self.search.rivals.effects[name] for name in key.effects]
        return [e for e in effects if e.hook == "noise"]

    def louder_draws(
        self, key: ModelKey, use: NDArray[np.bool_] | None = None
    ) -> tuple[Array, Array]:
        """Return posterior draws of a set's effects on the noise, and its factors.

        Args:
            key: Key of the set.
            use: Parts of the trials that count, shape (f,); None takes all.

        Returns:
            Natural values, shape (n, k), and factors on the error, shape (n, N).
        """
        rng = np.random.default_rng(derive_seed(self.search.rivals.seed, "louder"))
        num = self.num_louder
        share = self.mixture(key, use).share.reshape(-1, num).sum(0)
        drawn = rng.choice(num, size=num, p=share / share.sum())
        phi, scale = self._scales(self.louder(key))
        return phi[drawn], scale[drawn]

    def _scales(self, effects: Sequence[Effect]) -> tuple[Array, Array]:
        """Return draws of effects on the noise, and its factors, (n, k) and (n, N)."""
        rivals, num, parts = self.search.rivals, self.num_louder, []
        for e in effects:
            with forked_generators(rivals.seed, "louder", e.name):
                phi = e.sample(num).double()
            null = e.null_phi(1)
            ends = np.stack(support_bounds(support_of(e.prior), e.phi_dim))
            if bool(null.isfinite().all()) and not np.isfinite(ends).all(0).any():
                width = torch.tensor(np.resize(WIDTHS, num))
                phi = null + width[:, None] * (phi - null)
            parts.append(phi)
        named = {e.name: phi for e, phi in zip(effects, parts, strict=True)}
        scale = rivals.simulator.noise_scale(named, num)
        assert scale is not None
        phi = np.concatenate([part.numpy() for part in parts], 1)
        return phi, np.maximum(scale, 1e-12)

    def outliers(self, key: ModelKey) -> dict[float, float]:
        """Return the probability that each trial is the one, if one has a gross error.

        Args:
            key: Effects of the model.

        Returns:
            Probabilities by the trials' indices, most probable first; empty for few.
        """
        own = ModelKey(key.effects, OUTLIER)
        if own not in self.keys(key):
            return {}
        trials = self._measured
        share = self._by_trial(self.mixture(own))
        order = np.argsort(-share, kind="stable")
        return {float(trials[k]): float(share[k]) for k in order}

    def needed(self, key: ModelKey, least: float) -> tuple[float, ...]:
        """Return the trials without which the data do not point to some effects.

        Args:
            key: Effects of the model.
            least: Log Bayes factor against the bare model that points to them, nats.
        """
        bare, found = ModelKey(), self.search.found
        gain = self.log_evidence(key) - self.log_evidence(bare)
        many = len(self.search.errors.trials) >= self.fewest
        if key not in found or gain < least or not many:
            return ()
        without = np.array(
            [
                self.mixture(key, ~own).log_evidence
                - self.mixture(bare, ~own).log_evidence
                for own in self.search.errors.trials
            ]
        )
        # Without a gross error the fits may lie elsewhere.
        beside = [self.mixture(ModelKey(k.effects, OUTLIER)) for k in (key, bare)]
        suspect = self._by_trial(beside[1]).argmax()
        gain = beside[0].log_evidence - beside[1].log_evidence
        without[suspect] = min(without[suspect], gain)
        return (*self._measured[without < least].tolist(),)

    @property
    def _measured(self) -> Array:
        """Indices of the trials with a measurement, shape (t,)."""
        rivals = self.search.rivals
        return rivals.trials.index.numpy()[np.unique(rivals.measurements.trial)]

    def chi_square(self, key: ModelKey) -> tuple[float, float]:
        """Return a model's chi-square and its tail, by all that is declared.

        With effects on the noise it is the least among draws of their posterior. Where
        the correlation of errors is declared it counts; where it is unknown, numbers
        count as independent.

        Args:
            key: Effects of the model.
        """
        model = self.search.model(self.predicting(key))
        residual = model.residual[: model.num]
        if self.louder(key):
            residual = residual / self.louder_draws(key)[1]
        square = float(np.min(self.square(residual)))
        return square, float(chi2.sf(square, model.chi_square[1]))

    def square(self, residual: Array) -> Array:
        """Return sums of squares, (...,), of residuals (..., N) in sensor deviations.

        They are those of the innovations where a correlation is declared.
        """
        cells = self.search.errors.cells
        innovations = cells[0].whiten(residual) if len(cells) == 1 else residual
        return (innovations**2).sum(-1)
