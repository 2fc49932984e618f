"""Outcomes that nothing in the prior explains: found, named and left out."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.campaign.state import FAR, Trial
from sbi_active.inference.beliefs.belief import Belief, UnchangedBelief
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import Simulations, simulate
from sbi_active.simulation.workers.settings import Workers

SUSPECT = 0.01  # surprise below which a trial is compared with the prior
NOTABLE = 0.1  # ranges beyond all simulations that are worth a word
CONSTANT = 1e-6  # range over size below which a number counts as one that never varies


def is_suspect(trial: Trial) -> bool:
    """Return whether a trial may lie where nothing in the prior leads."""
    known = trial.surprise is not None and trial.outlyingness is None
    return not known or (trial.surprise or 0.0) < SUSPECT


def simulate_prior(
    trial: Trial,
    simulator: Callable[..., Any],
    prior: Distribution,
    *,
    num_samples: int,
    seed: int,
    workers: Workers,
) -> Simulations:
    """Return simulations of a trial's action from the prior.

    Args:
        trial: Trial whose action is simulated.
        simulator: ``simulator(theta, action)``.
        prior: Prior of theta.
        num_samples: Number of rows.
        seed: Seed of the simulations.
        workers: Workers that run the simulations.
    """
    with forked_generators(seed, "theta"):
        theta = prior.sample(torch.Size([num_samples]))
    action = trial.action.expand(num_samples, -1)
    return simulate(
        simulator, theta, action, seed=derive_seed(seed, "x"), workers=workers
    )


def outlyingness(x: Tensor, drawn: Tensor) -> float:
    r"""Return how far an outcome lies beyond all simulations, in their range.

    .. math::
        \max_j \frac{\max(x_j - \max_i x_{ij},\; \min_i x_{ij} - x_j,\; 0)}
        {\max_i x_{ij} - \min_i x_{ij}}

    over the numbers j that were measured; infinite if no simulation had one of them.
    The range of a number that never varies is its size.

    Args:
        x: The outcome, shape x_shape; NaN where nothing was measured.
        drawn: Simulated outcomes, shape (n, *x_shape).

    Example:
        >>> outlyingness(torch.tensor([3.0]), torch.tensor([[0.0], [0.5], [1.0]]))
        2.0
    """
    observed, rows = x.double().flatten(), drawn.double().flatten(1)
    own = observed.isfinite()
    observed, rows = observed[own], rows[:, own]
    present = rows.isfinite()
    if not len(observed):
        return 0.0
    if not bool(present.any(0).all()):
        return math.inf
    low = torch.where(present, rows, torch.inf).amin(0)
    high = torch.where(present, rows, -torch.inf).amax(0)
    size = torch.maximum(low.abs(), high.abs())
    width = torch.where(high - low > CONSTANT * size, high - low, size)
    # A number that is always zero has no size of its own.
    width = torch.where(width > 0, width, width.amax().clamp_min(1e-30))
    beyond = torch.maximum(observed - high, low - observed).clamp_min(0.0)
    return float((beyond / width).max())


def doubts(trials: Sequence[Trial]) -> list[str]:
    """Return the doubts about trials beyond all simulations, with advice."""
    return [
        _doubt(t) for t in trials if t.is_measured and (t.outlyingness or 0.0) > NOTABLE
    ]


def in_doubt(
    belief: Distribution, prior: Distribution, texts: Sequence[str]
) -> Distribution:
    """Return the same belief, marked untrustworthy for reasons; itself without any.

    Args:
        belief: Belief from the trials that are explained; the prior before any.
        prior: The original prior.
        texts: Reasons from :func:`doubts`.
    """
    if not texts:
        return belief
    if isinstance(belief, Belief):
        marked = copy.copy(belief)
    else:
        marked = UnchangedBelief(prior, belief)
    known = marked.diagnostics
    marked.diagnostics = known.extended(warnings=()).warned(*texts, *known.warnings)
    return marked


def _doubt(trial: Trial) -> str:
    far, index = trial.outlyingness or 0.0, trial.index
    where = f"trial {index} at action {_shown(trial.action)}: x = {_shown(trial.x)} "
    if math.isinf(far):
        what = "has numbers that no simulation from the prior has"
    else:
        what = (
            f"is {far:.3g} times the range of the simulations from the prior away from "
            "anything simulated"
        )
    so = ", so that the belief leaves it out" if far > FAR else ""
    return (
        f"SA102 {where}{what}{so}; correct it with tell(x, trial={index}) or take it "
        f"out with withdraw({index}), and criticize() where it is right"
    )


def _shown(values: Tensor | None) -> str:
    numbers = [] if values is None else values.flatten().tolist()
    shown = ", ".join(f"{v:.6g}" for v in numbers[:6])
    return f"[{shown}{', ...' if len(numbers) > 6 else ''}]"
