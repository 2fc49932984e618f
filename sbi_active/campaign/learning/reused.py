"""Rows of earlier campaigns for the first round of a new one."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.seeding import derive_seed
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.reweighting import FEW, reuse
from sbi_active.simulation.outcomes import Simulations
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers
from sbi_active.simulation.workers.store import find_store

LOGGER = logging.getLogger("sbi_active")


def first_round(
    simulator: Callable[..., Any],
    prior: Distribution,
    theta: Tensor,
    action: Tensor,
    *,
    actions: ActionSpace,
    num_earlier: int,
    seed: int,
    workers: Workers,
) -> tuple[Simulations, int, int]:
    """Return simulations of the first round, those that a bank has among them.

    The new ones are stored with their density under the prior, so that the next
    campaign can weight them.

    Args:
        simulator: The current one.
        prior: Prior that theta was drawn from.
        theta: Parameters of the round, shape (n, theta_dim).
        action: Actions of the round, shape (n, action_dim).
        actions: Rows of other actions are not taken.
        num_earlier: Rows of the bank that were there before this campaign; what it
            stored itself must not count when it begins again.
        seed: Seed of the new simulations, and of the choice of earlier ones.
        workers: Workers that run the simulations.

    Returns:
        At most n rows without the missing, how many were simulated, and how many of
        these are missing.
    """
    store = find_store(simulator)
    if not isinstance(store, Bank):
        rows = simulate(simulator, theta, action, seed=seed, workers=workers)
        return rows.without_missing(), len(rows), rows.counts["missing"]
    earlier = _earlier(store, prior, actions, num_earlier, len(theta), seed)
    first = 0 if earlier is None else len(earlier)
    if earlier is not None and first == len(theta):
        return earlier, 0, 0
    rows = simulate(
        simulator,
        theta[first:],
        action[first:],
        seed=seed,
        workers=workers,
        store=store.drawn_from(prior, label="prior"),
    )
    known = rows.without_missing()
    if earlier is not None:
        parts = [(getattr(earlier, n), getattr(known, n)) for n in ("theta", "action")]
        x = torch.cat([earlier.x, known.x])
        known = Simulations(*map(torch.cat, parts), x=x)
    return known, len(rows), rows.counts["missing"]


def _earlier(
    bank: Bank,
    prior: Distribution,
    actions: ActionSpace,
    num_earlier: int,
    num_rows: int,
    seed: int,
) -> Simulations | None:
    """Return as many earlier rows as they are worth; None if that is too few."""
    if not num_earlier:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # their number is said below
            found = reuse(bank, prior)
    except ValueError:  # none whose proposal is known
        return None
    permitted = actions.contains(bank.read(found.rows).action)
    weights = found.weights * (permitted & (found.rows < num_earlier))
    if not weights.sum() > 0:
        return None
    found = replace(found, weights=weights / weights.sum())
    worth = found.effective_sample_size
    used = min(num_rows, int(worth))
    LOGGER.info(
        "first round: %d of %d rows are read from %s, whose %d earlier rows are worth "
        "%.0f draws from the prior",
        *(used if used >= FEW else 0, num_rows, bank.path, int((weights > 0).sum())),
        worth,
    )
    if used < FEW:
        return None
    return found.resample(used, seed=derive_seed(seed, "reused"))
