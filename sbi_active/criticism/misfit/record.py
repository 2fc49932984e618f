"""The verdict of linear models as the closed loop's results, with posterior draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.rival_set import NUM_DRAWS, RivalSet
from sbi_active.criticism.linear.left_out import Candidate
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.guesses import guess_residual
from sbi_active.criticism.misfit.verdict import Misfit
from sbi_active.criticism.results import (
    UNEXPLAINED,
    Detection,
    Estimate,
    Evidence,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.steps.detection import LEVEL, THRESHOLD
from sbi_active.criticism.steps.predictive import predict
from sbi_active.criticism.steps.tracing import (
    credible_set,
    estimate_of,
    likeliest_first,
)
from sbi_active.criticism.under_misfit import Misfit as Found
from sbi_active.criticism.under_misfit import ModelError
from sbi_active.inference.engine import WeightedDraws
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Probability from which an admitted model is recorded with its errors and draws, and
#: how many are at most.
SHOWN, MOST_SHOWN = 0.01, 8
#: Weight by the error on left-out parts from which a next action is to tell a model
#: from others, and how many are at most: each costs some hundred trials a candidate.
COUNTS, MOST_COUNTED = 0.05, 6
#: Root mean square difference of two effects' fits, in sensor deviations, below which
#: they are nearly the same.
CLOSE = 1.0


def detected(misfit: Misfit) -> Detection:
    """Return the detection of the bare model's misfit, by the verdict's evidence."""
    bare = misfit.search.found[ModelKey()]
    return detection_of(bare, misfit.log_bayes_factor, LEVEL)


def detection_of(bare: Candidate, log_b: float, level: float) -> Detection:
    """Return the detection by a linear bare model.

    Args:
        bare: The model.
        log_b: Log Bayes factor of everything else against it, nats.
        level: Tail probability of its chi-square that is an alarm by itself.
    """
    square, freedom, p_value = bare.model.chi_square
    return Detection(
        log_bayes_factor=log_b,
        standard_error=0.0,
        lower=log_b,
        threshold=THRESHOLD,
        chi_square=square,
        degrees_of_freedom=float(freedom),
        p_value=p_value,
        level=level,
        null_log_evidence=bare.posterior.log_sensor,
        null_cross_check=None,
    )


def traced(misfit: Misfit, held_out: Trials | None) -> Tracing:
    """Return the verdict, and record the models behind it with posterior draws.

    Args:
        misfit: The models and what helps.
        held_out: Trials on which the recorded models are scored; None for none.
    """
    rivals, search, choice = misfit.rivals, misfit.search, misfit.choice
    if getattr(rivals.model.noise, "measurement_sd", None) is None:
        rivals.widen(2 * search.found[ModelKey()].model.rms)
    singles = [ModelKey((name,)) for name in search.names]
    shown = [k for k, p in choice.probabilities.items() if p >= SHOWN][:MOST_SHOWN]
    tabled = [*dict.fromkeys([*shown, choice.key, ModelKey()])]
    weights = _weights(misfit)
    evidences = {}
    for key in dict.fromkeys([*tabled, *singles, *weights]):
        evidences[str(key)] = _record(misfit, key)
    models = [_scored(misfit, key, held_out) for key in tabled]
    found = _found(misfit, tuple(models), weights)
    named = found.named
    probabilities = {str(k): choice.probabilities.get(k, 0.0) for k in tabled}
    probabilities |= {
        n: choice.probabilities.get(ModelKey((n,)), 0.0) for n in search.names
    }
    ordered = dict(sorted(probabilities.items(), key=lambda item: -item[1]))
    return Tracing(
        verdict=str(ModelKey(named)) if named else UNEXPLAINED,
        chosen=choice.key.effects,
        probabilities=ordered,
        inclusion={n: choice.inclusion.get(n, 0.0) for n in rivals.effects},
        credible_set=credible_set(ordered),
        equivalent=(*misfit.equivalent,),
        near=(),
        aliases=_aliases(misfit),
        estimates=_estimates(misfit, evidences),
        evidences=evidences,
        robust=misfit.is_robust(),
        guesses=() if choice.key.effects else guess_residual(search),
        beside=tuple(n for n in choice.key.effects if n not in named),
        misfit=found,
        p_value=misfit.model(choice.key).chi_square[2],
    )


def with_intervals(tracing: Tracing, misfit: Misfit) -> Tracing:
    """Return a verdict of other evidence with the intervals that hold under misfit.

    Args:
        tracing: Tracing of numbers without a time axis, of which no declared effect
            predicts left-out trials better: larger noise or something undeclared.
        misfit: The models.
    """
    found = dict(tracing.evidences)
    for name, own in found.items():
        key = ModelKey(own.key.effects)
        if key not in misfit.search.found:
            continue
        model = misfit.model(key)
        u = _drawn(misfit.rivals, model, model.u, misfit.covariances(key)[1])
        draws = misfit.rivals.rival(key).coordinates.to_z(u)[:, : model.own]
        found[name] = replace(own, draws=draws, narrow=own.draws)
    return replace(tracing, evidences=found)


def _record(misfit: Misfit, key: ModelKey) -> Evidence:
    """Return a model's record, and keep its draws as its posterior sample."""
    model, log_z = misfit.model(key), misfit.search.found[key].posterior.log_process
    own, shown = misfit.covariances(key)
    # Draws as wide as misfit asks leave the valleys of what bends: left-out trials are
    # predicted from the best fit, and so are others.
    return keep_draws(
        *(misfit.rivals, key, model, model.u, own, log_z),
        best=model.u,
        shown=shown,
    )


def keep_draws(
    rivals: RivalSet,
    key: ModelKey,
    model: LinearModel,
    center: Array,
    cov: Array,
    log_z: float,
    *,
    best: Array | None = None,
    shown: Array | None = None,
    louder: Array | None = None,
    chi_square: float | None = None,
    unit: Array | None = None,
) -> Evidence:
    """Return a linear model's record, and keep its draws as its posterior sample.

    Args:
        rivals: Rivals that keep them.
        key: Key of the model, with an error or with effects on the noise.
        model: Fitted model of its effects on the prediction.
        center: Center of its posterior, shape (d,).
        cov: Covariance of its posterior, shape (d, d).
        log_z: Log evidence of the model, nats.
        best: Point from which other trials are predicted, shape (d,); None takes the
            draws.
        shown: Covariance of the draws that intervals are of, shape (d, d); None takes
            that of those which predict.
        louder: Draws of effects on the noise, natural values, shape (n, k).
        chi_square: Chi-square with these effects; None takes the fitted model's.
        unit: Unit of the model's residuals, shape (N,), where draws are to be weighed
            by the simulator; None leaves them.
    """

    def linear(u: Array) -> Array:
        return unit * (model.residual + (u - model.u) @ model.jacobian.T)

    if key in rivals.fits:
        return rivals.fits[key].evidence
    before = rivals.simulator.num_simulations if key.effects else 0
    rival = rivals.rival(key)
    u, at, mode = _drawn(rivals, model, center, cov), best, model.u
    if louder is not None:
        u, mode = _with_louder(rival, model, u, louder), None
    equal = np.full(NUM_DRAWS, 1 / NUM_DRAWS)
    sample = WeightedDraws(
        u=u,
        weight=equal,
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        method="linear",
    )
    own = sum(rival.coordinates.joint.sizes)
    if shown is not None:
        u = _drawn(rivals, model, center, shown)
    evidence = Evidence(
        key=key,
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        engine="linear",
        num_simulations=rivals.simulator.num_simulations - before,
        names=rivals.names_of(rival),
        draws=rival.coordinates.to_z(u)[:, :own],
        best_chi_square=model.chi_square[0] if chi_square is None else chi_square,
        best=None if at is None else rival.coordinates.to_z(at[None])[0, :own],
    )
    weighs = None if unit is None else linear
    rivals.fits[key] = Fit(rival, sample, evidence, at, mode, weighs)
    return evidence


def _with_louder(rival: Rival, model: LinearModel, u: Array, phi: Array) -> Array:
    """Return draws of a model with draws of effects on the noise, shape (n, d).

    Args:
        rival: Rival with these effects.
        model: Model without them.
        u: Draws of its coordinates, shape (n, d').
        phi: Draws of theirs, natural values, shape (m, k), repeated as needed.
    """
    c, noisy = rival.coordinates, np.zeros(rival.dim, dtype=bool)
    for effect in rival.effects:
        noisy[rival.columns()[effect.name]] = effect.hook == "noise"
    drawn = np.empty((len(u), rival.dim))
    drawn[:, ~noisy] = u
    z = c.to_z(np.where(noisy, 0.0, drawn))
    z[:, noisy] = phi[np.arange(len(u)) % len(phi)]
    drawn[:, noisy] = c.from_z(z)[:, noisy]
    return np.clip(drawn, c.low, c.high)


def _drawn(rivals: RivalSet, model: LinearModel, center: Array, cov: Array) -> Array:
    """Return draws of a model's coordinates within their bounds, (NUM_DRAWS, d)."""
    rng = np.random.default_rng(derive_seed(rivals.seed, "linear", str(model.key)))
    values, vectors = eigh(cov)
    root = vectors * np.sqrt(np.clip(values, 0, None))
    u = center + rng.normal(size=(NUM_DRAWS, len(cov))) @ root.T
    return np.clip(u, model.low, model.high)


def _weights(misfit: Misfit) -> dict[ModelKey, float]:
    """Return the models that count, by their errors on left-out parts."""
    weights = misfit.weights
    kept = [key for key, weight in weights.items() if weight >= COUNTS]
    return {key: weights[key] for key in kept[:MOST_COUNTED]}


def _found(
    misfit: Misfit, models: tuple[ModelError, ...], weights: dict[ModelKey, float]
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


def _open_forms(misfit: Misfit) -> dict[str, str]:
    """Return the declared families of the effects that are named, if more is missing.

    Laws of friction, for example, imitate each other: while something undeclared is
    left, another form of the family, declared or not, may be what is there.
    """
    if misfit.passes(misfit.choice.key):
        return {}
    effects = misfit.rivals.effects
    named = [effects[name] for name in misfit.choice.named]
    return {e.name: str(e.family) for e in named if e.family != e.hook}


def _scored(misfit: Misfit, key: ModelKey, held_out: Trials | None) -> ModelError:
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


def _held_out(misfit: Misfit, key: ModelKey, held_out: Trials) -> Array:
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


def _estimates(misfit: Misfit, evidences: dict[str, Evidence]) -> tuple[Estimate, ...]:
    bare = evidences[str(ModelKey())].log_evidence
    return likeliest_first(
        estimate_of(
            misfit.rivals.effects[name],
            evidences[name],
            probability=misfit.choice.inclusion[name],
            log_bayes_factor=evidences[name].log_evidence - bare,
        )
        for name in misfit.search.names
    )


def _aliases(misfit: Misfit) -> tuple[frozenset[str], ...]:
    """Return pairs of effects that fit the trials nearly alike and about as well."""
    found = misfit.search.found
    return alike(
        misfit.search,
        {n: found[ModelKey((n,))].posterior.log_process for n in misfit.search.names},
    )


def alike(search: Search, log_z: dict[str, float]) -> tuple[frozenset[str], ...]:
    """Return pairs of effects that fit the trials nearly alike and about as well.

    Args:
        search: Search that has fitted them alone.
        log_z: Log evidence of each effect alone, by name.
    """
    best = max(log_z.values(), default=-np.inf)
    likely = [n for n, value in log_z.items() if value > best - THRESHOLD]
    pairs = []
    for i, a in enumerate(likely):
        for b in likely[i + 1 :]:
            one, two = (search.found[ModelKey((n,))].model.residual for n in (a, b))
            if np.mean((one - two) ** 2) < CLOSE**2:
                pairs.append(frozenset({a, b}))
    return (*pairs,)
