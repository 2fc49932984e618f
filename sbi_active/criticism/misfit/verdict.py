"""Whether every model misses the trials by more than the sensor's error, and then what.

If one fits to the sensor's error, evidence on the simulator itself decides, and this
module is not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.contradictions import OutlyingTrial
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.errors import Posterior
from sbi_active.criticism.linear.left_out import Candidate, leave_out
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.guesses import gained_by_guesses
from sbi_active.criticism.misfit.intervals import covariances
from sbi_active.criticism.misfit.rule import Choice, Rule, Scored
from sbi_active.criticism.misfit.weights import weights_by_error
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.steps.equivalence import is_large
from sbi_active.criticism.steps.missed_trials import outlying_trials
from sbi_active.criticism.steps.tracing import RESCALED
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Trials with the largest error, each of which alone may be what no model fits.
NUM_SUSPECTS = 3
#: Trials below which none can be told to be the one that errs.
FEWEST_TRIALS = 3


@dataclass
class Misfit:
    """The models of trials that none of them explains to the sensor's error.

    Attributes:
        search: Search with its models.
        rivals: Rivals that the models are made of.
        equivalent: Groups of effects that nothing separates.
        choice: Choice of what helps.
        standard: Function that returns a model's squared errors on left-out parts, as
            the rule takes them.
        log_bayes_factor: Log Bayes factor of anything with a residual process against
            the bare model with the sensor's error alone, nats.
        rule: Rule that decides which effects help.
    """

    search: Search
    rivals: RivalSet
    equivalent: Sequence[frozenset[str]]
    choice: Choice
    standard: Callable[[Candidate], Array]
    log_bayes_factor: float
    rule: Rule

    def model(self, key: ModelKey) -> LinearModel:
        """Return a fitted model."""
        return self.search.found[key].model

    def passes(self, key: ModelKey) -> bool:
        """Return whether a model's chi-square passes against the sensor."""
        return self.model(key).chi_square[2] > self.rule.passes

    def posterior(self, key: ModelKey, use: NDArray[np.bool_]) -> Posterior:
        """Return the posterior of a model by some parts of the trials."""
        found = self.search.found[key]
        return self.search.errors.posterior(found.model, found.grams, use)

    def covariances(self, key: ModelKey) -> tuple[Array, Array]:
        """Return covariances of a model's coordinates about its best fit, (d, d).

        The first is that of the model, which predictions have. Intervals have the
        second, with what coordinates differ by from model to model besides.
        """
        found = self.search.found[key]
        action = self.rivals.trials.action.numpy()
        action = action[np.unique(self.rivals.measurements.trial)]
        return covariances(
            found.model,
            found.posterior,
            found.left,
            self.search.errors,
            action,
            between=self._between(key),
        )

    def replaces(self, verdict: str) -> bool:
        """Return whether it says more than a verdict of numbers without a time axis.

        All models have numbers that scatter more than declared, each for itself: beside
        them effects that help have a Bayes factor of 100, or one is probably the cause.
        Several effects, which fit much, give way to a probable cause.
        """
        choice = self.choice
        if verdict == UNEXPLAINED:
            return bool(choice.key.effects)
        own, bare = (self.search.found[k].log_p for k in (choice.key, ModelKey()))
        if verdict == SCATTER and own - bare > np.log(self.rule.decisive):
            return True
        return any(choice.support[n].better > self.rule.sure for n in choice.named)

    @cached_property
    def weights(self) -> dict[ModelKey, float]:
        """Weight of each model by its errors on left-out parts."""
        found = self.search.found
        return weights_by_error(
            {key: candidate.left.square for key, candidate in found.items()},
            {key: candidate.log_prior for key, candidate in found.items()},
            derive_seed(self.rivals.seed, "weights"),
        )

    def _between(self, key: ModelKey) -> Array:
        """Return the variance of a model's coordinates among those that predict, (d,).

        By the square roots of the weights: errors of neighboring parts have causes in
        common, and count for about half as many.
        """
        search, u = self.search, self.model(key).u
        total, norm = np.zeros_like(u), np.zeros_like(u)
        for other, weight in self.weights.items():
            common = ModelKey(tuple(n for n in key.effects if n in other.effects))
            own = search.columns(key, common)
            its = self.model(other).u[search.columns(other, common)]
            total[own] += np.sqrt(weight) * (its - u[own]) ** 2
            norm[own] += np.sqrt(weight)
        return total / np.maximum(norm, 1e-300)

    def selected_without(self, fold: int) -> ModelKey:
        """Return the model that is chosen without one part of the trials."""
        errors = self.search.errors
        use = np.ones(errors.num_folds, bool)
        use[fold] = False
        standard = standard_errors(self.search, use)

        def score(c: Candidate) -> Scored:
            posterior = errors.posterior(c.model, c.grams, use)
            log_p = c.log_prior + posterior.log_process
            return Scored(log_p, standard(c), c.model.rms**2)

        return settled(self.search, score, self.equivalent, self.rule).key

    def outlying(self) -> tuple[OutlyingTrial, ...]:
        """Return the trials that err far more than the others let expect.

        They are found by the residuals of the verdict's model for each trial as fitted
        to the others, in units of what these let expect: a trial that alone shows what
        an effect does is not one of them.
        """
        errors, found = self.search.errors, self.search.found[self.choice.key]
        if not errors.is_by_trial:
            return ()
        rows, names = np.unique(errors.measurements.trial), self.rivals.trials.names
        square = np.nan_to_num(self.standard(found), nan=1.0)
        return tuple(
            OutlyingTrial(
                position=int(rows[k]),
                name=names[rows[k]],
                times=times,
                size=float(np.sqrt(found.left.square[k])),
            )
            for k, times in outlying_trials(square.tolist())
        )

    def is_robust(self) -> bool:
        """Return whether effect priors of another scale leave what helps."""
        errors = self.search.errors
        for factor in RESCALED:

            def score(c: Candidate, factor: float = factor) -> Scored:
                posterior = errors.posterior(c.model, c.grams, factor=factor)
                log_p = c.log_prior + posterior.log_process
                return Scored(log_p, self.standard(c), c.model.rms**2)

            again = settled(self.search, score, self.equivalent, self.rule)
            if again.key != self.choice.key:
                return False
        return True


def standard_errors(
    search: Search, use: NDArray[np.bool_] | None = None
) -> Callable[[Candidate], Array]:
    """Return a function of a model's squared errors on left-out parts, (f,), cached.

    Trials count as much as the likeliest model has them vary, the same for all models.

    Args:
        search: The models.
        use: Parts of the trials that tell of it; None takes all.
    """
    errors = search.errors
    best = max(search.found.values(), key=lambda c: c.log_p)
    posterior = best.posterior
    if use is not None:
        posterior = errors.posterior(best.model, best.grams, use)
    weight = errors.weight(posterior)
    known: dict[ModelKey, Array] = {}

    def standard(c: Candidate) -> Array:
        key = c.model.key
        if key not in known:
            known[key] = leave_out(c.model, errors, use, weight=weight).standard
        return known[key]

    return standard


def find_misfit(
    search: Search | None,
    equivalent: Sequence[frozenset[str]] = (),
    *,
    is_known: bool = False,
    rule: Rule = Rule(),  # noqa: B008  (frozen)
) -> Misfit | None:
    """Return the models and what helps; None if one fits to the sensor's error.

    A model fits if no model is improved by a residual process by a Bayes factor of 20,
    or if a single trial, which may have a gross error, accounts for the improvement. A
    set of several effects that fits proves little: so many imitate what was not
    declared. It is judged as if it missed, and so by what left-out trials say of each
    of its effects.

    Args:
        search: Fits the models; None if no linear model has the error.
        equivalent: Groups of effects that no permitted action separates.
        is_known: No model fits: what remains was found to be no error of a sensor.
            Without a time axis nothing else tells.
        rule: What decides which effects help.
    """
    if search is None or not search.sensor.is_known:
        return None
    if not (is_known or search.rivals.measurements.is_sequence):
        return None
    rivals = search.rivals
    search.fit_singles()
    if not is_known and not _misses(search):
        return None
    if search.look_again() and not is_known and not _misses(search):
        return None
    search.fit_larger()
    if not is_known:
        if is_large(rivals.library) and not _misses(search):
            return None
        if _is_one_trial(search):
            return None

    standard = standard_errors(search)

    def score(c: Candidate) -> Scored:
        return Scored(c.log_p, standard(c), c.model.rms**2)

    timed = rivals.measurements.is_sequence
    guessed = None if timed else partial(gained_by_guesses, search)
    choice = settled(search, score, equivalent, rule, guessed)
    log_p = [c.log_p for c in search.found.values()]
    sensor_alone = search.found[ModelKey()].posterior.log_sensor
    log_b = log_sum_exp(np.array(log_p)) - sensor_alone
    given = search, rivals, equivalent, choice, standard
    return Misfit(*given, float(log_b), rule)


def without(trials: Trials, outlying: Sequence[OutlyingTrial]) -> Trials:
    """Return all trials but some of those that were fitted."""
    fitted = [k for k, role in enumerate(trials.role) if role == "fit"]
    gone = {fitted[trial.position] for trial in outlying}
    return trials.select([k for k in range(len(trials)) if k not in gone])


def settled(
    search: Search,
    score: Callable[[Candidate], Scored],
    equivalent: Sequence[frozenset[str]],
    rule: Rule,
    guessed: Callable[[ModelKey, str], float] | None = None,
) -> Choice:
    """Return the choice, once every part of the top model is fitted.

    Args:
        search: The models so far.
        score: Function that returns what the rule needs of a model.
        equivalent: Groups of effects that nothing separates.
        rule: Rule that decides which effects help.
        guessed: Function that returns the nats that guesses in the place of an effect
            gain over it; None asks none.
    """
    scored: dict[ModelKey, Scored] = {}
    timed = search.rivals.measurements.is_sequence
    while True:
        for key, candidate in search.found.items():
            if key not in scored:
                scored[key] = score(candidate)
        tops = rule.starts(scored, search.names, timed=timed)
        missing = [key for top in tops for key in _missing(search, top)]
        if not missing:
            return rule.choose(
                *(scored, search.names, equivalent), timed=timed, guessed=guessed
            )
        for key in missing:
            search.fit_set(key)


def _missing(search: Search, key: ModelKey) -> list[ModelKey]:
    """Return the subsets of a set that were not fitted, smaller ones first."""
    wanted: list[ModelKey] = []
    todo = [key]
    while todo:
        for part in todo.pop().parts:
            if part not in wanted:
                wanted.append(part)
                todo.append(part)
    missing = [k for k in wanted if k not in search.found]
    return sorted(missing, key=lambda k: len(k.effects))


def _misses(
    search: Search, use: NDArray[np.bool_] | None = None, most: int | None = None
) -> bool:
    """Return whether even the best model gains by a residual process.

    Args:
        search: Search that has fitted the models.
        use: Parts of the trials that count; None for all.
        most: Effects of the models that count; None for all.
    """
    best_sensor = best_process = -np.inf
    for key, c in search.found.items():
        if most is not None and len(key.effects) > most:
            continue
        p: Posterior = c.posterior
        if use is not None:
            p = search.errors.posterior(c.model, c.grams, use)
        best_sensor = max(best_sensor, c.log_prior + p.log_sensor)
        best_process = max(best_process, c.log_prior + p.log_process)
    return best_process - best_sensor > THRESHOLD


def _is_one_trial(search: Search) -> bool:
    """Return whether a model of at most one effect fits all trials but one.

    Several effects fit all but the one trial that tells.
    """
    errors, trial = search.errors, search.rivals.measurements.trial
    if len(np.unique(trial)) < FEWEST_TRIALS:  # two that agree outvote one
        return False
    models = [c for k, c in search.found.items() if len(k.effects) <= 1]
    best = max(models, key=lambda c: c.log_prior + c.posterior.log_sensor)
    square = np.bincount(trial, best.model.residual**2)
    for suspect in np.argsort(-square)[:NUM_SUSPECTS]:
        # A part of few trials is a piece of one: all pieces of the suspect go.
        use = np.ones(errors.num_folds, bool)
        use[np.unique(errors.fold[trial == suspect])] = False
        if not _misses(search, use, 1):
            return True
    return False
