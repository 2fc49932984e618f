"""A straight line with a few trials, which attacks on the closed loop set out from."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect, Report, Trials, close_loop

PRIOR = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 17))
XI = torch.tensor([-2.0, -1.5, -1.0, -0.25, 0.5, 1.0, 1.5, 2.0])
TRUE, NOISE = (1.5, -0.8), 0.1


def line(theta: Tensor, action: Tensor, cubic: Any = 0.0) -> Tensor:
    """Return a straight line, to which a cubic term may be added, shape (n, 1)."""
    xi = action[:, 0]
    return (theta[:, 0] + theta[:, 1] * xi + cubic * xi**3)[:, None]


def normal(sd: float) -> Independent:
    """Return a prior of one strength about zero."""
    return Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)


MODEL = SimulatorModel(line, noise=GaussianNoise(NOISE))
CUBIC = Effect.keyword("cubic", prior=normal(0.5))


def observed(effect: str) -> Effect:
    """Return an effect on x by its name."""
    changes = {
        "bend": lambda x, phi, action, context: x + phi * action**2,
        "drift": lambda x, phi, action, context: x + phi * context.index[:, None] ** 2,
    }
    return Effect(
        effect, hook="observation", prior=normal(0.5), null=0.0, apply=changes[effect]
    )


LIBRARY = [CUBIC, observed("bend")]


def measured(seed: int = 0, cubic: float = 0.0, xi: Tensor = XI) -> Tensor:
    """Return noisy outcomes, shape (n, 1), float64."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.tensor([TRUE], dtype=torch.float64).expand(len(xi), -1)
    x = line(theta, xi[:, None].double(), cubic)
    return x + NOISE * torch.randn(x.shape, generator=generator, dtype=torch.float64)


def loop(x: Any, xi: Any = XI, *, model: Any = MODEL, **options: Any) -> Report:
    """Return the report of a loop without the costly parts."""
    keys = ("effects", "actions", "seed", "evaluate", "plan", "summaries")
    chosen = {"effects": LIBRARY, "actions": ACTIONS, "evaluate": False, "plan": False}
    chosen |= {k: options.pop(k) for k in keys if k in options}
    return close_loop(model, PRIOR, Trials(xi, x, **options), **chosen)


@cache
def usual() -> Report:
    """Return the report on right trials."""
    return loop(measured())


def refused(words: str, call: Any) -> None:
    """Check that a call ends in a ValueError that has some words."""
    try:
        call()
    except ValueError as error:
        said = str(error)
    else:
        said = "nothing"
    assert words in said, said


def theta_is_right(report: Report) -> None:
    """Check the parameters of the verdict's model against the truth."""
    table = report.parameters.set_index("parameter")
    for name, true in zip(("theta_1", "theta_2"), TRUE, strict=True):
        row = table.loc[name]
        kind = "after" if np.isfinite(row["after"]) else "before"
        assert abs(row[kind] - true) < 4 * row[f"{kind}_sd"], (name, row)
