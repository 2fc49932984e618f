"""Effects that the data and the permitted actions hardly separate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.steps.equivalence import every_action, noise_unit
from sbi_active.seeding import derive_seed, forked_generators

Array = NDArray[Any]

#: Root mean square difference of two effects' predictions over the permitted actions,
#: in standard deviations of the noise, below which they are nearly the same.
CLOSE = 1.0
#: Posterior draws behind a prediction.
NUM_DRAWS = 32


def near_aliases(
    rivals: RivalSet,
    log_z: Mapping[str, float],
    actions: ActionSpace | None,
    known: Sequence[frozenset[str]] = (),
) -> tuple[frozenset[str], ...]:
    r"""Return pairs of effects that are nearly the same here.

    Both have an evidence within log 20 of the best effect's, so that neither is worth
    an alarm against the other, and fitted to the trials their mean predictions differ
    over the permitted actions by less than the noise in the root mean square:

    .. math::
        \tfrac1N \sum_i (m_{a,i} - m_{b,i})^2 / s_i^2 < 1 .

    They are not equivalent: repeated trials, or stronger data, tell them apart.

    Args:
        rivals: The models.
        log_z: Evidence of each effect alone, nats.
        actions: The permitted ones; None compares on the trials at hand.
        known: Groups that are listed already.

    Returns:
        Pairs, none of them within a known group.
    """
    effects = [n for n, e in rivals.effects.items() if e.hook != "noise"]
    if not effects:
        return ()
    best = max(log_z[name] for name in effects)
    likely = [name for name in effects if log_z[name] > best - THRESHOLD]
    if len(likely) < 2:
        return ()
    trials = rivals.trials if actions is None else every_action(rivals, actions)
    simulator = TrialSimulator(
        rivals.simulator.model, trials, seed=derive_seed(rivals.seed, "aliases")
    )
    unit = noise_unit(rivals, simulator)
    mean = {name: _prediction(rivals, simulator, name) / unit for name in likely}
    found = []
    for i, a in enumerate(likely):
        for b in likely[i + 1 :]:
            gap = mean[a] - mean[b]
            gap = gap[np.isfinite(gap)]
            pair = frozenset({a, b})
            close = gap.size > 0 and np.mean(gap**2) < CLOSE**2
            if close and not any(pair <= group for group in known):
                found.append(pair)
    return tuple(found)


def _prediction(rivals: RivalSet, simulator: TrialSimulator, name: str) -> Array:
    """Return the posterior predictive mean with an effect, shape (N,)."""
    fit = rivals.fit(ModelKey((name,)))
    if fit.mode is not None and simulator.trials is rivals.trials:
        # The prediction of the best fit is simulated already.
        return rivals.measurements.x - fit.rival.residual(fit.mode[None])[0][0]
    evidence = fit.evidence
    draws = torch.from_numpy(evidence.draws[:NUM_DRAWS])
    size = rivals.effects[name].phi_dim
    phi = {name: draws[:, -size:]}
    theta = draws[:, :-size]
    for effect in rivals.nuisances:
        num = len(theta) * len(simulator.trials)
        with forked_generators(rivals.seed, "aliases", effect.name):
            drawn = effect.sample(num).double()
        phi[effect.name] = drawn.reshape(len(theta), -1, effect.phi_dim)
    return np.nanmean(simulator.predict(theta, phi)[0], axis=0)
