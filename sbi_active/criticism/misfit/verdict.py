"""The verdict of linear models: what the trials show, by one rule.

Every model has the same states of the error (:mod:`..linear.states`): with the one that
fits to the sensor's error, and where every model misses, the rule is the same
(:mod:`.rule`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import OutlyingTrial
from sbi_active.criticism.linear.left_out import Candidate, standard_errors
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import white_variance
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.linear.states import States
from sbi_active.criticism.misfit.guesses import gained_by_guesses
from sbi_active.criticism.misfit.rule import Choice, Compared, Rule
from sbi_active.criticism.misfit.scored import Scored
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Detection,
    ModelKey,
)
from sbi_active.criticism.steps.detection import LEVEL, THRESHOLD
from sbi_active.criticism.steps.missed_trials import outlying_trials
from sbi_active.inference.sampling.weights import log_sum_exp


def judge(
    search: Search,
    equivalent: Sequence[frozenset[str]] = (),
    rule: Rule = Rule(),  # noqa: B008  (frozen)
) -> Verdict:
    """Return the verdict of linear models.

    Args:
        search: Search that fits the models.
        equivalent: Groups of effects that no permitted action separates.
        rule: Rule of what helps and what is named.
    """
    search.fit_singles()
    return Verdict(search, equivalent, rule)


@dataclass
class Verdict:
    """The models of some trials, and what the rule says of them.

    Attributes:
        search: Search with its models.
        equivalent: Groups of effects that nothing separates.
        rule: Rule that decides which effects help.
    """

    search: Search
    equivalent: Sequence[frozenset[str]]
    rule: Rule

    def __post_init__(self) -> None:
        self.rivals = self.search.rivals
        self.states = States(self.search, self.rule.chance, self.rule.passes)
        self.timed = self.rivals.measurements.is_sequence

    @cached_property
    def detection(self) -> Detection:
        """Whether the bare model misses the trials."""
        states, rivals = self.states, self.rivals
        bare = self.search.found[ModelKey()]
        log_b = self._log_bayes_factor()
        square, p = states.chi_square(ModelKey())
        _, freedom, _ = bare.model.chi_square
        found = Detection(
            log_bayes_factor=log_b,
            threshold=THRESHOLD,
            chi_square=square,
            degrees_of_freedom=float(freedom),
            p_value=p,
            level=LEVEL if rivals.has_known_noise else 0.0,
        )
        noise, spare = rivals.model.noise, len(bare.model.residual) - len(bare.model.u)
        is_declared = noise is not None and noise.posterior is None and spare > 0
        if not is_declared or rivals.roughness.any():
            return found
        return replace(found, lower_p_value=float(chi2.cdf(square, spare)))

    def _log_bayes_factor(self, use: NDArray[np.bool_] | None = None) -> float:
        """Return the log Bayes factor of everything else against the bare model.

        The residual process, noise inflation and each effect have equal weights;
        effects that nothing separates count as one, and effects that nothing separates
        from the bare model, or that were screened out, do not count.
        """
        every = {e.name for e in self.rivals.library}
        shares = {UNEXPLAINED: 1.0, SCATTER: 1.0}
        for effect in self.rivals.library:
            group = self._group(effect.name)
            if NONE not in group:
                shares[effect.name] = 1 / len(group & every)
        total, kept = sum(shares.values()), {*self.rivals.effects, UNEXPLAINED, SCATTER}

        def log_z(name: str) -> float:
            return self.states.mixture(ModelKey.of(name), use).log_evidence

        parts = [
            log_z(name) + float(np.log(share / total))
            for name, share in shares.items()
            if name in kept
        ]
        return float(log_sum_exp(np.array(parts)) - log_z(NONE))

    def _group(self, name: str) -> frozenset[str]:
        """Return the effects that no permitted action tells from one, with it."""
        return next((g for g in self.equivalent if name in g), frozenset({name}))

    @cached_property
    def standard(self) -> Callable[[Candidate], Array]:
        """Function from a model to its squared errors on left-out parts, (f,)."""
        return standard_errors(self.search.found, self.search.errors)

    @cached_property
    def choice(self) -> Choice:
        """What helps, and what is named; without an alarm nothing."""
        if not self.detection.alarm:
            scored = {k: self._scored(c) for k, c in self.search.found.items()}
            return Compared(self.rule, scored, self.search.names).nothing()
        self.search.fit_larger()
        guessed = None if self.timed else partial(gained_by_guesses, self.search)
        return self._settled(self._scored, guessed)

    def _scored(
        self,
        c: Candidate,
        use: NDArray[np.bool_] | None = None,
        standard: Callable[[Candidate], Array] | None = None,
    ) -> Scored:
        """Return what the rule needs of a model."""
        joint = self.states.joint(c.model.key, use)
        log_p = c.log_prior + log_sum_exp(np.array([*joint.values()]))
        state = max(joint, key=joint.__getitem__).error
        beside, mixture = c.beside, self.search.errors.mixture
        if use is not None:
            beside = mixture(c.model, c.grams, use, beside=True)
        square = (standard or self.standard)(c)
        log_beside = c.log_prior + beside.log_evidence
        white, m = 1.0, self.search.errors.measurements
        if state == SCATTER:
            residual = c.model.residual[: c.model.num]
            white = max(white_variance(residual, m, self.search.errors.fold), 1.0)
        return Scored(log_p, square, c.model.rms**2, state, log_beside, white)

    def _settled(
        self,
        score: Callable[[Candidate], Scored],
        guessed: Callable[[ModelKey, str], float] | None = None,
    ) -> Choice:
        """Return the choice, once every part of the top models is fitted.

        Args:
            score: Function that returns what the rule needs of a model.
            guessed: Function that returns the nats that guesses in the place of an
                effect gain over it; None asks none.
        """
        search, scored = self.search, dict[ModelKey, Scored]()
        while True:
            for key, candidate in search.found.items():
                if key not in scored:
                    scored[key] = score(candidate)
            compared = Compared(self.rule, scored, search.names, self.timed)
            missing = [k for top in compared.starts() for k in _missing(search, top)]
            if not missing:
                choice = compared.choice(self.equivalent, guessed)
                bare = scored[ModelKey()]
                gain = scored[choice.key].gain(bare)
                # Numbers that scatter each for itself may follow anything a little.
                scatters = bare.state == SCATTER and not self.timed
                if not scatters or gain >= np.log(self.rule.decisive):
                    return choice
                return replace(choice, key=ModelKey(), named=(), support={}, instead={})
            for key in missing:
                search.fit_set(key)

    @cached_property
    def key(self) -> ModelKey:
        """Effects that help, with the most probable state of the error."""
        if not self.detection.alarm:
            return ModelKey()
        return self.states.likeliest(self.choice.key)

    @property
    def is_missed(self) -> bool:
        """Whether every model misses the trials by more than the sensor's error.

        Several effects that fit prove little, so many imitate what was not declared:
        they are shown as if they missed.
        """
        own = self.key
        scatters = own.error == SCATTER and bool(own.effects)
        several = len(self.choice.key.effects) > 1
        is_missed = scatters or several or own.error == UNEXPLAINED
        return self.search.sensor.has_size and is_missed

    @cached_property
    def probabilities(self) -> dict[ModelKey, float]:
        """Probabilities of the admitted models, the states of a bare one apart."""
        found = {ModelKey((name,)): 0.0 for name in self.rivals.effects}
        for key, p in self.choice.probabilities.items():
            for own, share in self.states.share(key).items():
                # What an effect on the noise makes of the error is an effect as well.
                model = own if own.error is None or not key.effects else key
                found[model] = found.get(model, 0.0) + p * share
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @cached_property
    def inclusion(self) -> dict[str, float]:
        """Probability of each effect among the admitted models."""
        found = dict.fromkeys(self.rivals.effects, 0.0) | self.choice.inclusion
        for key, p in self.choice.probabilities.items():
            for own, share in self.states.share(key).items():
                for effect in self.states.louder(own):
                    found[effect.name] += p * share
        return found

    @property
    def outliers(self) -> dict[float, float]:
        """Probability that each trial is the one, if one has a gross error."""
        if not self.detection.alarm:
            return {}
        # In place of effects, or beside them.
        is_beside = self.key.error == OUTLIER
        return self.states.outliers(self.choice.key if is_beside else ModelKey())

    @property
    def suspect(self) -> int | None:
        """Place of the trial that a gross error is in, if one has; None for none."""
        index = self.rivals.trials.index.tolist()
        return next((index.index(own) for own in self.outliers), None)

    def model(self, key: ModelKey) -> LinearModel:
        """Return a fitted model."""
        return self.search.found[key].model

    @property
    def p_value(self) -> float:
        """Tail of the verdict's chi-square; NaN where the error has no size."""
        key = ModelKey(self.key.effects)
        if not self.search.sensor.has_size:
            return float("nan")
        return self.states.chi_square(key)[1]

    @property
    def passes(self) -> bool:
        """Whether that chi-square passes against the sensor."""
        return self.p_value > self.rule.passes

    @property
    def helps(self) -> tuple[str, ...]:
        """Effects that help; of a model that explains, with those on the noise."""
        return self.choice.key.effects if self.is_missed else self.key.effects

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that are probably the cause.

        An error of no declared size that is larger explains nothing.
        """
        if self.is_missed:
            return self.choice.named
        return () if self.key.error == UNEXPLAINED else self.key.effects

    def beside(self, key: ModelKey) -> ModelKey:
        """Return a model in its most probable state of the error, if it has none."""
        has_one = key.error is not None or self.states.louder(key)
        return key if has_one else self.states.likeliest(key)

    def misses(self, key: ModelKey) -> bool:
        """Return whether a model misses the trials by more than the sensor's error."""
        misses = self.beside(key).error in (SCATTER, UNEXPLAINED)
        return self.is_missed or (self.search.sensor.has_size and misses)

    def shown(self, key: ModelKey) -> Array:
        r"""Return the covariance that intervals of a model's coordinates have, (d, d).

        .. math::
            \Sigma + \Sigma_J + \sum_m p_m (\hat u_m - \hat u) (\hat u_m - \hat u)^T

        with the jackknife's, which knows no process, and the models m that have further
        effects, as probable as they are beside a process: something undeclared may be
        what they take up. On tuning seeds of ``benchmarks/misfit`` each term is needed.
        """
        search, own = self.search, self.search.found[key]
        larger = [k for k in search.found if {*k.effects} >= {*key.effects}]
        log_p = np.array([search.found[k].log_p for k in larger])
        away = np.array([self.model(k).u[search.columns(k, key)] for k in larger])
        away = away - own.model.u
        spread = away.T * np.exp(log_p - log_sum_exp(log_p)) @ away
        return self.covariance(key) + own.left.jackknife() + spread

    def covariance(self, key: ModelKey) -> Array:
        r"""Return the covariance of a model's coordinates about its best fit, (d, d).

        .. math::
            \Sigma = \Sigma_{GLS} + \Delta \Delta^T, \qquad
            \Delta = \hat u_{LSQ} - \hat u_{GLS}

        with that of generalized least squares given a residual process, or a parameter
        that differs from trial to trial. What weighting the same residuals differently
        moves parameters by is an error of them too, beyond a bound of the prior as
        well, where the fit stays. It is one matrix, in which parameters make up for
        each other as they do in the trials, so that predictions follow from it. The
        center is that of least squares, which predicts new trials better.
        """
        own = self.search.found[key]
        apart = own.model.u - own.beside.mean
        return own.beside.cov + np.outer(apart, apart)

    def chosen_by(self, use: NDArray[np.bool_]) -> ModelKey:
        """Return the model that is chosen by some parts of the trials.

        Args:
            use: Parts of the trials that count, shape (f,).
        """
        gains = self._log_bayes_factor(use) >= THRESHOLD
        if not gains and not self.detection.by_chi_square:
            return ModelKey()
        standard = standard_errors(self.search.found, self.search.errors, use)
        key = self._settled(partial(self._scored, use=use, standard=standard)).key
        if self.is_missed:
            return key if key.effects else ModelKey(error=UNEXPLAINED)
        joint = self.states.joint(key, use)
        return max(joint, key=joint.__getitem__)

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
            OutlyingTrial(position=int(rows[k]), name=names[rows[k]], times=times)
            for k, times in outlying_trials(square.tolist())
        )


def _missing(search: Search, key: ModelKey) -> list[ModelKey]:
    """Return the subsets of a set that were not fitted, smaller ones first."""
    names = key.effects
    parts = chain.from_iterable(combinations(names, k) for k in range(len(names)))
    return [part for part in map(ModelKey, parts) if part not in search.found]
