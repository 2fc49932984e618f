"""Effects that the data and the permitted actions hardly separate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.steps.equivalence import every_action, noise_unit
from sbi_active.seeding import derive_seed


def near_aliases(
    search: Search,
    log_z: Mapping[str, float],
    actions: ActionSpace | None,
    known: Sequence[frozenset[str]] = (),
    *,
    close: float = 1.0,
) -> tuple[frozenset[str], ...]:
    r"""Return pairs of effects that are nearly the same here.

    Both have an evidence within log 20 of the best effect's, so that neither is worth
    an alarm against the other, and fitted to the trials their predictions differ
    over the permitted actions by less than the noise in the root mean square:

    .. math::
        \tfrac1N \sum_i (m_{a,i} - m_{b,i})^2 / s_i^2 < 1 .

    They are not equivalent: repeated trials, or stronger data, tell them apart.

    Args:
        search: Search that has fitted each effect alone.
        log_z: Evidence of each effect alone, nats.
        actions: The permitted ones; None compares on the trials at hand.
        known: Groups that are listed already.
        close: Root mean square below which they are nearly the same, in standard
            deviations of the noise.

    Returns:
        Pairs, none of them within a known group.
    """
    best = max((log_z[name] for name in search.names), default=-np.inf)
    likely = [name for name in search.names if log_z[name] > best - THRESHOLD]
    if len(likely) < 2:
        return ()
    mean = _predictions(search, likely, actions)
    found = []
    for a, b in combinations(likely, 2):
        gap = mean[a] - mean[b]
        gap, pair = gap[np.isfinite(gap)], frozenset({a, b})
        is_close = gap.size > 0 and np.mean(gap**2) < close**2
        if is_close and not any(pair <= group for group in known):
            found.append(pair)
    return tuple(found)


def _predictions(
    search: Search, names: Sequence[str], actions: ActionSpace | None
) -> dict[str, Array]:
    """Return what each effect predicts at its best fit, in deviations, (N,) each."""
    models = {name: search.model(ModelKey((name,))) for name in names}
    if actions is None:
        return {n: -m.scale * m.residual[: m.num] for n, m in models.items()}
    rivals = search.rivals
    trials = every_action(rivals, actions)
    seed = derive_seed(rivals.seed, "aliases")
    simulator = TrialSimulator(rivals.simulator.model, trials, seed=seed)
    unit, found = noise_unit(rivals, simulator), {}
    for name, model in models.items():
        coordinates = rivals.rival(model.key).coordinates
        theta, phi = coordinates.split(model.u[None])
        for effect in rivals.nuisances:
            null = effect.null_phi(len(trials), finite=True)
            phi[effect.name] = null.reshape(1, len(trials), -1)
        found[name] = simulator.predict(theta, phi)[0][0] / unit
    return found
