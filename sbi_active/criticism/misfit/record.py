"""The verdict of linear models as the closed loop's results, with posterior draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.linear.fits import refitted
from sbi_active.criticism.misfit.draws import (
    bends,
    by_weights,
    left_out_fit,
    linear_fit,
)
from sbi_active.criticism.misfit.guesses import guess_residual
from sbi_active.criticism.misfit.near_aliases import near_aliases
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import (
    OUTLIER,
    UNEXPLAINED,
    Estimate,
    Evidence,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.steps.equivalence import equivalent_effects
from sbi_active.criticism.steps.influence import is_left_to_chance, withdrawn
from sbi_active.criticism.steps.predictive import predict
from sbi_active.criticism.steps.tracing import (
    credible_set,
    estimate_of,
    likeliest_first,
)
from sbi_active.criticism.under_misfit import Misfit as Found
from sbi_active.criticism.under_misfit import ModelError

#: Probability from which an admitted model is recorded with its errors and draws, and
#: how many are at most.
SHOWN, MOST_SHOWN = 0.01, 8


def traced(
    found: Verdict,
    held_out: Trials | None,
    *,
    actions: ActionSpace | None = None,
    near: bool = True,
) -> Tracing:
    """Return the verdict, and record the models behind it with posterior draws.

    Args:
        found: The models and what helps.
        held_out: Trials on which the recorded models are scored; None for none.
        actions: The permitted ones, for what they hardly separate.
        near: Whether to look for groups that these trials do not separate as well.
    """
    rivals, key = found.rivals, found.key
    if found.is_missed:
        return _beside_misfit(found, held_out)
    is_unexplained = key.error == UNEXPLAINED  # with an error of no declared size
    chosen = () if is_unexplained else key.effects
    shown = [k for k, p in found.choice.probabilities.items() if p >= SHOWN]
    keys = [*found.states.keys(ModelKey()), *shown[:MOST_SHOWN], key]
    keys += [ModelKey((name,)) for name in rivals.effects]
    keys = [k for k in dict.fromkeys(keys) if k.error is None or not k.effects]
    probabilities = found.probabilities
    evidences = {str(k): _record(found, k) for k in keys}
    groups = equivalent_effects(rivals, None) if near else ()
    aliases: tuple[frozenset[str], ...] = ()
    if found.detection.alarm:
        singles = {n: evidences[n].log_evidence for n in rivals.effects}
        known = [*found.equivalent, *groups]
        aliases = near_aliases(found.search, singles, actions, known)
    effects = ModelKey(key.effects)
    gain = found.states.log_evidence(ModelKey(found.choice.key.effects, UNEXPLAINED))
    tracing = Tracing(
        verdict=str(ModelKey(chosen) if chosen else ModelKey(error=key.error)),
        chosen=chosen,
        probabilities=probabilities,
        inclusion=found.inclusion,
        credible_set=credible_set(probabilities),
        equivalent=(*found.equivalent,),
        near=groups,
        aliases=aliases,
        estimates=_estimates(found, evidences),
        evidences=evidences,
        robust=found.is_robust(),
        guesses=_guesses(found) if is_unexplained else (),
        beside=key.effects if is_unexplained else (),
        outliers=found.outliers,
        needed=found.states.needed(effects, THRESHOLD) if chosen else (),
        p_value=_tail(found, effects),
        log_process=gain - found.states.log_evidence(found.choice.key),
        trial_names=dict(
            zip(rivals.trials.index.tolist(), rivals.trials.names, strict=True)
        ),
    )
    return withdrawn(tracing) if is_left_to_chance(tracing) else tracing


def _beside_misfit(misfit: Verdict, held_out: Trials | None) -> Tracing:
    """Return the verdict where every model misses, or several effects fit."""
    rivals, search, choice = misfit.rivals, misfit.search, misfit.choice
    if getattr(rivals.model.noise, "measurement_sd", None) is None:
        rivals.widen(2 * search.found[ModelKey()].model.rms)
    singles = [ModelKey((name,)) for name in search.names]
    shown = [k for k, p in choice.probabilities.items() if p >= SHOWN][:MOST_SHOWN]
    tabled = [*dict.fromkeys([*shown, choice.key, ModelKey()])]
    weights = _weights(misfit)
    evidences = {}
    for key in dict.fromkeys([*tabled, *singles, *weights]):
        if key not in rivals.fits:
            rivals.fits[key] = _beside(misfit, key)
        evidences[str(key)] = rivals.fits[key].evidence
    models = [_scored(misfit, key, held_out) for key in tabled]
    found = _found(misfit, tuple(models), weights)
    named = found.named
    probabilities = {str(k): choice.probabilities.get(k, 0.0) for k in tabled}
    probabilities |= {
        n: choice.probabilities.get(ModelKey((n,)), 0.0) for n in search.names
    }
    ordered = dict(sorted(probabilities.items(), key=lambda item: -item[1]))
    beside = {k.effects[0]: search.found[k].posterior.log_process for k in singles}
    guess = not (choice.key.effects if rivals.measurements.is_sequence else named)
    return Tracing(
        verdict=str(ModelKey(named)) if named else misfit.key.error or UNEXPLAINED,
        chosen=choice.key.effects,
        probabilities=ordered,
        inclusion=misfit.inclusion,
        credible_set=credible_set(ordered),
        equivalent=(*misfit.equivalent,),
        near=(),
        aliases=near_aliases(search, beside, None),
        estimates=_estimates(misfit, evidences),
        evidences=evidences,
        robust=misfit.is_robust(),
        guesses=_guesses(misfit) if guess else (),
        beside=tuple(n for n in choice.key.effects if n not in named),
        misfit=found,
        p_value=misfit.model(choice.key).chi_square[2],
    )


def _guesses(found: Verdict) -> tuple[tuple[str, float], ...]:
    known = found.search.sensor.is_known
    is_timed = found.rivals.measurements.is_sequence
    return guess_residual(found.search) if known or not is_timed else ()


def _tail(found: Verdict, key: ModelKey) -> float:
    """Return the tail of a model's chi-square; NaN where the error has no size."""
    known = found.search.sensor.is_known
    return found.states.chi_square(key)[1] if known else float("nan")


def fitted(found: Verdict, key: ModelKey, use: NDArray[np.bool_]) -> Fit:
    """Return a linear model with its posterior by some parts of the trials.

    Args:
        found: Verdict with the model.
        key: Key of the model.
        use: Parts of the trials that count, shape (f,).
    """
    known = use[found.search.errors.fold]
    if found.is_missed:
        return _beside(found, key, use, known)
    whole = found.rivals.fits.get(key)
    if whole is not None and whole.evidence.engine != "linear":
        return left_out_fit(whole, known)
    return _alone(found, key, use, known)


def _alone(
    found: Verdict,
    key: ModelKey,
    use: NDArray[np.bool_] | None = None,
    known: NDArray[np.bool_] | None = None,
) -> Fit:
    """Return a model that may fit. Beside a gross error, its trial tells little."""
    states, search = found.states, found.search
    at = own = states.mixture(key, use)
    if key.effects and found.key == ModelKey(key.effects, OUTLIER):
        at = states.mixture(found.key, use)
    model = search.model(states.predicting(key))
    if use is not None and np.isfinite(search.sensor.df):
        model, at = by_weights(model, search, use)
    given = found.rivals, key, model, at.mean, at.cov, own.log_evidence
    options = {"known": known, "suspect": found.suspect}
    if not states.louder(key):
        return linear_fit(*given, unit=search.unit, **options)
    phi, square = states.louder_draws(key, use)[0], states.chi_square(key)[0]
    return linear_fit(*given, louder=phi, chi_square=square, **options)


def _beside(
    misfit: Verdict,
    key: ModelKey,
    use: NDArray[np.bool_] | None = None,
    known: NDArray[np.bool_] | None = None,
) -> Fit:
    """Return a model that misses.

    Wide draws leave the valleys of what bends: left-out trials are predicted from the
    best fit, and so are others.
    """
    own, errors = misfit.search.found[key], misfit.search.errors
    model, log_z, best = own.model, own.posterior.log_process, own.model.u
    if use is not None:
        search, kept = misfit.search, use[errors.fold]
        best = refitted(search.rival(key), model, search.units, kept)
    return linear_fit(
        *(misfit.rivals, key, model, best, misfit.covariance(key), log_z),
        best=best,
        shown=misfit.shown(key) if use is None else None,
        known=known,
    )


def _record(found: Verdict, key: ModelKey, *, fewest: float = 50.0) -> Evidence:
    """Return the record of a model that may fit, and keep its draws.

    The bare model and those that are likely have samples of the simulator's own
    posterior where they bend.

    Args:
        found: Verdict with the model.
        key: Key of the model.
        fewest: Effective draws from which such a sample is taken, and not a linear
            model's. Half and twice say little else: it is some hundreds or a few.
    """
    rivals = found.rivals
    if key not in rivals.fits and _is_sampled(found, key):
        fit = rivals.fit(key, found.search.model(key).u[None] if key.effects else None)
        if fit.evidence.effective_sample_size >= fewest:
            log_z = found.states.log_evidence(key)
            evidence = replace(fit.evidence, log_evidence=log_z)
            rivals.fits[key] = replace(fit, evidence=evidence)
        else:
            del rivals.fits[key]  # a few draws would claim to know what is open
    if key not in rivals.fits:
        rivals.fits[key] = _alone(found, key)
    return rivals.fits[key].evidence


def _is_sampled(found: Verdict, key: ModelKey) -> bool:
    states, search = found.states, found.search
    if key not in search.found:
        return False
    rivals = found.rivals
    is_dear = rivals.measurements.is_sequence or rivals.simulator.is_stochastic
    if is_dear and key not in (ModelKey(), found.key):
        return False
    others = [*search.found, *states.keys(ModelKey())]
    least = max(map(states.log_evidence, others)) - THRESHOLD
    several = len(key.effects) > 1 and key != found.key
    if several or (key.effects and states.log_evidence(key) < least):
        return False
    return bends(search, key)


def _weights(
    misfit: Verdict,
    *,
    # Weight by the error on left-out parts from which a next action is to tell a
    # model from others, and how many are at most: each costs some hundred trials a
    # candidate.
    counts: float = 0.05,
    most_counted: int = 6,
) -> dict[ModelKey, float]:
    """Return the models that count, by their errors on left-out parts."""
    weights = misfit.weights
    kept = [key for key, weight in weights.items() if weight >= counts]
    return {key: weights[key] for key in kept[:most_counted]}


def _found(
    misfit: Verdict, models: tuple[ModelError, ...], weights: dict[ModelKey, float]
) -> Found:
    choice, search = misfit.choice, misfit.search
    m = search.rivals.measurements
    last = search.found[choice.key]
    return Found(
        models=models,
        helps=choice.key.effects,
        named=choice.named,
        support=choice.support,
        open_forms=_open_forms(misfit),
        sensor=np.sqrt(_by_channel(search.unit**2, m.channel)),
        passes=misfit.passes(choice.key),
        size=last.posterior.size,
        time_scale=last.posterior.time_scale if m.is_sequence else np.nan,
        left_out="trials" if search.errors.is_by_trial else "parts of trials",
        weights={str(key): weight for key, weight in weights.items()},
        instead=choice.instead,
    )


def _open_forms(misfit: Verdict) -> dict[str, str]:
    """Return the declared families of the effects that are named, if more is missing.

    Laws of friction, for example, imitate each other: while something undeclared is
    left, another form of the family, declared or not, may be what is there.
    """
    if misfit.passes(misfit.choice.key):
        return {}
    effects = misfit.rivals.effects
    named = [effects[name] for name in misfit.choice.named]
    return {e.name: str(e.family) for e in named if e.family != e.hook}


def _scored(misfit: Verdict, key: ModelKey, held_out: Trials | None) -> ModelError:
    """Return a model's errors on trials that it was not fitted to."""
    search, rivals = misfit.search, misfit.rivals
    left, bare = (search.found[k].left for k in (key, ModelKey()))
    excess = max(left.mean_square - 1, 0.0) / max(bare.mean_square - 1, 1e-2)
    m = rivals.measurements
    kept = search.errors.is_scored
    own = _by_channel((left.error * search.unit)[kept] ** 2, m.channel[kept])
    return ModelError(
        name=str(key),
        probability=misfit.choice.probabilities.get(key, 0.0),
        left_out=np.sqrt(own),
        held_out=None if held_out is None else _held_out(misfit, key, held_out),
        remains=float(min(excess, 1.0)),
        parts=(*left.square[np.isfinite(left.square)].tolist(),),
    )


def _held_out(misfit: Verdict, key: ModelKey, held_out: Trials) -> Array:
    """Return the root mean square error on held-out trials by channel, (c,)."""
    prediction = predict(misfit.rivals, held_out, key=key)
    m = Measurements.of(held_out, is_sequence=True)
    channel = np.zeros(int(np.prod(m.shape)), dtype=np.int64)
    channel[m.position] = m.channel
    x = held_out.x.double().numpy().ravel()[prediction.position]
    error = x - prediction.middle
    return np.sqrt(_by_channel(error**2, channel[prediction.position]))


def _by_channel(square: Array, channel: NDArray[np.int64]) -> Array:
    return np.bincount(channel, square) / np.maximum(np.bincount(channel), 1)


def _estimates(found: Verdict, evidences: dict[str, Evidence]) -> tuple[Estimate, ...]:
    bare = evidences[str(ModelKey())].log_evidence
    return likeliest_first(
        estimate_of(
            effect,
            evidences[name],
            probability=found.inclusion[name],
            log_bayes_factor=evidences[name].log_evidence - bare,
        )
        for name, effect in found.rivals.effects.items()
        if name in evidences
    )
