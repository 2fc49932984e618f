"""A report of a machine that lacks a drag, and what changes make of it."""

from dataclasses import replace

import numpy as np
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Trials, close_loop, results
from sbi_active.criticism.contradictions import Misfit, ModelError, Support
from tests.effects import added, on_outcomes, with_error

DRAG = on_outcomes(
    "drag",
    lambda x, phi, action, context: x + phi * action * action.abs(),
    family="dynamics",
)
SHUFFLED = [2.0, -1.0, 3.0, 1.0, -2.0, -3.0, 1.5, -1.5, 2.5]
ACTIONS = DiscreteActions(torch.linspace(-3, 3, 13), names=["speed"], units=["m/s"])
MODEL = SimulatorModel(
    lambda theta, xi: (theta[:, :1] + theta[:, 1:] * xi).expand(-1, 6), noise=0.1
)


def trials(action=SHUFFLED[:8], **more) -> Trials:
    """Return six numbers a trial, with a drag of a tenth."""
    action = torch.tensor(action)[:, None]
    x = (0.3 + 0.5 * action + 0.1 * action * action.abs()).repeat(1, 6)
    return Trials(action, with_error(x, 0.1), **more)


FITTED = trials()
MADE = close_loop(
    MODEL,
    BoxUniform(-torch.ones(2), torch.ones(2)),
    trials(SHUFFLED[:8] + [2.5, -2.5, 0.5, -0.5], role=["fit"] * 8 + ["held out"] * 4),
    effects=[DRAG, added("tilt", torch.abs)],
    actions=ACTIONS,
)


def tracing(verdict: str = "drag", **changes) -> results.Tracing:
    chosen = (verdict,) if verdict == "drag" else ()
    return replace(MADE.tracing, **({"verdict": verdict, "chosen": chosen} | changes))


def misfit(left_out, held_out=(None, None), *, sensor=(0.005,)) -> Misfit:
    """Return models that miss, by errors of the bare one and of that with drag."""
    models = tuple(
        ModelError(
            name=name,
            probability=float(name == "drag"),
            left_out=np.atleast_1d(left),
            held_out=None if held is None else np.atleast_1d(held),
            remains=0.9,
        )
        for name, left, held in zip(("none", "drag"), left_out, held_out, strict=True)
    )
    return Misfit(
        models=models,
        helps=("drag",),
        named=(),
        support={"drag": Support(inclusion=0.9, better=0.9, gained=9.0, remains=0.9)},
        sensor=np.array(sensor),
        passes=False,
    )


def residuals(
    shape=(6,), *, size: float = 1.0, num: int = 8, times=None
) -> results.Residuals:
    rng = np.random.default_rng(1)
    z = size * rng.normal(size=(num, *shape))
    return results.Residuals(
        action=np.array(SHUFFLED[:num])[:, None],
        index=np.arange(num, dtype=float),
        times=times,
        x=z + 2,
        mean=np.full_like(z, 2.0),
        sd=np.ones_like(z),
        refitted=z,
        correlation=0.8 if times is not None else 0.0,
        noise="declared",
        names=(*map(str, range(num)),),
    )


def report(**changes):
    return replace(MADE, **({"trials": FITTED} | changes))
