"""Draws of models that the trials refute, which know of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.results import Estimate, Evidence, ModelKey, Tracing
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.seeding import derive_seed


def widened(
    tracing: Tracing, seed: int, within: Callable[[ModelKey, Array], Array]
) -> Tracing:
    r"""Return a verdict whose refuted models have draws that know of it.

    The posterior of a model that misses the trials is as narrow as the sensor allows,
    about a wrong place. Draws of one that is behind the verdict's by a Bayes factor of
    20 are spread by the root of the ratio of both chi-squares (Birge), and moved by
    what separates both models' means, :math:`(\bar u_v - \bar u)\, n` with a standard
    normal n for each draw: the verdict's effects, left out, shift what is left.

    Args:
        tracing: Tracing with effects as the verdict.
        seed: Seed of the draws.
        within: Moves draws of a model, shape (n, k), into the bounds of its prior.

    References:
        Birge, Physical Review 40 (1932), for the ratio.
    """
    best = tracing.evidences.get(str(ModelKey(tracing.chosen)))
    if not tracing.chosen or best is None:
        return tracing
    found = dict(tracing.evidences)
    for name, own in found.items():
        near = own.log_evidence > best.log_evidence - THRESHOLD
        if near or own.key.error is not None:
            continue
        draws = _widened(own, best, derive_seed(seed, "refuted", name))
        draws = within(own.key, draws)
        found[name] = replace(own, draws=draws, narrow=own.draws)
    estimates = [_estimate(e, found[e.name].draws) for e in tracing.estimates]
    return replace(tracing, evidences=found, estimates=(*estimates,))


def _estimate(estimate: Estimate, draws: Array) -> Estimate:
    """Return an effect's estimate by the draws of the model that has it alone."""
    phi = draws[:, -len(estimate.mean) :]
    return replace(estimate, mean=phi.mean(0), sd=phi.std(0))


def _widened(own: Evidence, best: Evidence, seed: int) -> Array:
    ratio = own.best_chi_square / max(best.best_chi_square, 1.0)
    mean = own.draws.mean(0)
    known = dict(zip(best.names, best.draws.mean(0), strict=True))
    apart = np.array([known.get(n, m) for n, m in zip(own.names, mean, strict=True)])
    normal = np.random.default_rng(seed).normal(size=(len(own.draws), 1))
    spread = np.sqrt(max(ratio, 1.0)) * (own.draws - mean)
    return mean + spread + normal * (apart - mean)
