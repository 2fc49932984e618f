"""The verdict of linear models as the closed loop's results, with posterior draws."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import Misfit, ModelError
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.misfit.contrary import is_left_to_chance, withdrawn
from sbi_active.criticism.misfit.draws import posterior, shown
from sbi_active.criticism.misfit.guesses import guess_residual
from sbi_active.criticism.misfit.scored import weights_by_error
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import (
    UNEXPLAINED,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.detection import THRESHOLD, credible_set
from sbi_active.criticism.steps.predictive import predict
from sbi_active.seeding import derive_seed

#: Probability from which an admitted model is recorded with its errors and draws.
SHOWN = 0.01


def traced(
    found: Verdict,
    held_out: Trials | None,
) -> tuple[Tracing, RivalSet]:
    """Return the verdict, and the models behind it with posterior draws.

    Args:
        found: The models and what helps.
        held_out: Trials on which the recorded models are scored; None for none.
    """
    rivals, is_missed = found.rivals, found.is_missed
    probabilities = _tabled(found) if is_missed else found.probabilities
    fits = {
        key: shown(found, posterior(found, rivals, key))
        for key in dict.fromkeys(_recorded(found))
    }
    models = rivals.with_fits(fits)
    evidences = {str(key): fit.evidence for key, fit in models.fits.items()}
    by_name = {str(key): p for key, p in probabilities.items()}
    helps, named = found.helps, found.named
    error = found.key.error or (UNEXPLAINED if is_missed else None)
    chosen = helps if is_missed else named
    tracing = Tracing(
        verdict=str(ModelKey(named) if named else ModelKey(error=error)),
        chosen=chosen,
        probabilities=by_name,
        inclusion=found.inclusion,
        credible_set=credible_set(by_name),
        equivalent=(*found.equivalent,),
        effects=rivals.effects,
        evidences=evidences,
        guesses=_guesses(found),
        beside=tuple(n for n in helps if n not in named),
        p_value=found.p_value,
        outliers=found.outliers,
        aliases=like_the_verdict(found, chosen) if found.detection.alarm else (),
        **(_missing(found, models, held_out) if is_missed else _explaining(found)),
    )
    is_withdrawn = not is_missed and is_left_to_chance(tracing)
    return withdrawn(tracing) if is_withdrawn else tracing, models


def _explaining(found: Verdict) -> dict[str, Any]:
    """Return the part of a tracing that is of models one of which explains."""
    states, best = found.states, found.choice.key
    gain = states.log_evidence(ModelKey(best.effects, UNEXPLAINED))
    needed = states.needed(ModelKey(found.named), THRESHOLD) if found.named else ()
    return {"needed": needed, "log_process": gain - states.log_evidence(best)}


def _tabled(found: Verdict) -> dict[ModelKey, float]:
    """Return the probabilities of what is listed if every model misses."""
    p, singles = found.choice.probabilities, map(ModelKey, zip(found.search.names))
    keys = [*_shown(found), found.choice.key, ModelKey(), *singles]
    return dict(sorted(((k, p.get(k, 0.0)) for k in keys), key=lambda item: -item[1]))


def _missing(
    found: Verdict, models: RivalSet, held_out: Trials | None
) -> dict[str, Any]:
    """Return the part of a tracing that is of models that all miss the trials.

    Laws of friction, for example, imitate each other: while something undeclared is
    left, another form of a declared family, declared or not, may be what is there.
    """
    choice, search, m = found.choice, found.search, found.rivals.measurements
    named = [found.rivals.effects[name] for name in choice.named]
    open_forms = {e.name: str(e.family) for e in named if e.family != e.hook}
    tabled = dict.fromkeys([*_shown(found), choice.key, ModelKey()])
    misfit = Misfit(
        models=tuple(_scored(found, models, key, held_out) for key in tabled),
        helps=choice.key.effects,
        named=choice.named,
        support=choice.support,
        open_forms={} if found.passes else open_forms,
        sensor=np.sqrt(m.by_channel(search.unit**2)),
        passes=found.passes,
        left_out="trials" if search.errors.is_by_trial else "parts of trials",
        weights={str(key): weight for key, weight in _weights(found).items()},
        instead=choice.instead,
    )
    return {"misfit": misfit}


def _recorded(found: Verdict) -> list[ModelKey]:
    """Return the models that are recorded with their posteriors."""
    singles = [ModelKey((name,)) for name in found.rivals.effects]
    if found.is_missed:
        singles = [key for key in singles if key in found.search.found]
        return [
            *_shown(found),
            found.choice.key,
            *found.choice.key.parts,  # which trials may prove each effect against
            ModelKey(),
            *singles,
            *_weights(found),
        ]
    p, states = found.probabilities, found.states
    louder = [key for key in p if states.louder(key) and p[key] >= SHOWN]
    keys = [*states.keys(ModelKey()), *_shown(found), found.key, *louder, *singles]
    return [key for key in keys if key.error is None or not key.effects]


def _shown(found: Verdict) -> list[ModelKey]:
    """Return the admitted models that are recorded with their errors and draws."""
    p = found.choice.probabilities
    return [key for key in p if p[key] >= SHOWN][:8]


def _guesses(found: Verdict) -> tuple[tuple[str, float], ...]:
    """Return what the residual may follow where nothing that was declared explains."""
    is_open = found.is_missed or found.key.error == UNEXPLAINED
    if found.timed or found.named or not is_open:
        return ()
    return guess_residual(found.search)


def _weights(misfit: Verdict) -> dict[ModelKey, float]:
    """Return the models that count, by their errors on left-out parts.

    A next action is to tell these apart, six at most: each costs some hundred trials a
    candidate.
    """
    found = misfit.search.found
    weights = weights_by_error(
        {key: candidate.left.square for key, candidate in found.items()},
        {key: candidate.log_prior for key, candidate in found.items()},
        derive_seed(misfit.rivals.seed, "weights"),
    )
    return dict([(k, w) for k, w in weights.items() if w >= 0.05][:6])


def _scored(
    misfit: Verdict, models: RivalSet, key: ModelKey, held_out: Trials | None
) -> ModelError:
    """Return a model's errors on trials that it was not fitted to."""
    search, rivals = misfit.search, misfit.rivals
    left, bare = (search.found[k].left for k in (key, ModelKey()))
    excess = max(left.mean_square - 1, 0.0) / max(bare.mean_square - 1, 1e-2)
    kept = search.errors.is_scored
    square = (left.error * search.unit)[kept] ** 2
    own = rivals.measurements.part(kept).by_channel(square)
    return ModelError(
        name=str(key),
        probability=misfit.choice.probabilities.get(key, 0.0),
        left_out=np.sqrt(own),
        held_out=None if held_out is None else _held_out(models, key, held_out),
        remains=float(min(excess, 1.0)),
        parts=(*left.square[np.isfinite(left.square)].tolist(),),
    )


def _held_out(models: RivalSet, key: ModelKey, held_out: Trials) -> Array:
    """Return the root mean square error on held-out trials by channel, (c,)."""
    prediction = predict(models, held_out, key=key)
    m = prediction.measurements
    return np.sqrt(m.by_channel((m.x - prediction.middle) ** 2))


def like_the_verdict(
    found: Verdict, chosen: Sequence[str]
) -> tuple[frozenset[str], ...]:
    r"""Return pairs of an effect of the verdict and one that is nearly the same here.

    Both alone have an evidence within log 20 of the best effect's, so that neither is
    worth an alarm against the other, and fitted to the trials their predictions differ
    by less than the noise in the root mean square:

    .. math::
        \tfrac1N \sum_i (m_{a,i} - m_{b,i})^2 / s_i^2 < 1 .

    They need not be equivalent, which is stated already: another action, repeated
    trials, or stronger data may tell them apart.

    Args:
        found: The verdict, whose search has fitted each effect alone.
        chosen: Effects that it adds.
    """
    search, keys = found.search, {n: ModelKey((n,)) for n in found.search.names}
    models = {name: search.model(key) for name, key in keys.items()}
    log_z = {
        name: search.found[key].beside.log_evidence
        if found.is_missed
        else found.states.log_evidence(key)
        for name, key in keys.items()
    }
    best = max(log_z.values(), default=-np.inf)
    likely = [name for name, value in log_z.items() if value > best - THRESHOLD]

    def is_close(a: str, b: str) -> bool:
        one, two = (m.scale * m.residual[: m.num] for m in (models[a], models[b]))
        return float(np.mean((one - two) ** 2)) < 1

    return tuple(
        frozenset(pair)
        for pair in combinations(likely, 2)
        if {*pair} & {*chosen}
        and not any({*pair} <= group for group in found.equivalent)
        and is_close(*pair)
    )
