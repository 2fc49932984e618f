"""Plain least squares of a leg's free run, given the effects that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.measured.go2_leg import Leg
from sbi_active.criticism import AugmentedSimulator, Effect
from sbi_active.criticism.rivals.trial_simulator import conditions_of_trials

__all__ = ["fit_leg"]

Array = NDArray[np.float64]

#: Where parameters start, by the end of their names, and strengths, in deviations.
START = {"armature": 0.02, "damping": 0.15, "frictionloss": 0.25, "scale": 0.9}
STRENGTH = 0.3
#: Relative step of finite differences, and evaluations of the Jacobian at most.
DIFFERENCE, EVALUATIONS = 1e-3, 15
#: Samples at rest, which are not compared.
AT_REST = 17
MILLI = 1e3


def fit_leg(
    leg: Leg, parameters: Mapping[str, Any], effects: Sequence[Effect]
) -> dict[str, Any]:
    """Return the fit of one free run over the fitted triangles, and its errors.

    Args:
        leg: Whose record it is.
        parameters: Of ``from_mjcf``.
        effects: That the simulator is given.
    """
    robot = leg.robot(parameters, [leg.log(0, leg.split)])
    model, trials = AugmentedSimulator(robot.simulator, [*effects]), robot.trials
    assert trials is not None
    sizes = [len(parameters), *[effect.phi_dim for effect in effects]]
    names = [e.name for e in effects]

    def residual(rows: Array) -> Array:
        theta, *phi = torch.from_numpy(rows).split(sizes, 1)
        alike = torch.zeros(len(rows), dtype=torch.long)
        x = model.evaluate(
            theta,
            dict(zip(names, phi, strict=True)),
            trials.action.double().expand(len(rows), -1),
            context=conditions_of_trials(trials, alike, robot.simulator),
        )
        left = (x.numpy() - leg.position[: leg.split])[:, AT_REST:]
        return np.nan_to_num(MILLI * left.reshape(len(rows), -1), nan=MILLI)

    start = np.array([_start(name) for name in parameters])
    draws = [effect.declared_draws().numpy() for effect in effects]
    sds = np.concatenate([np.zeros(0), *[np.sqrt((d**2).mean(0)) for d in draws]])
    low = np.zeros(len(parameters))
    high = np.array([bounds[1] for bounds in parameters.values()], dtype=float)
    least = [np.where((d >= 0).all(0), 0.0, -np.inf) for d in draws]
    low, high = (
        np.concatenate([low, *least]),
        np.append(high, np.full(len(sds), np.inf)),
    )
    x0 = np.concatenate([start, STRENGTH * sds])
    scale = np.maximum(np.abs(x0), 0.02)

    def jacobian(x: Array) -> Array:
        steps = DIFFERENCE * scale
        steps = np.where(x + steps > high, -steps, steps)
        both = residual(np.concatenate([x[None], x + np.diag(steps)]))
        return ((both[1:] - both[0]) / steps[:, None]).T

    found = least_squares(
        lambda x: residual(x[None])[0],
        x0,
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale=scale,
        max_nfev=EVALUATIONS,
    )
    values = torch.from_numpy(found.x)[None]
    run = leg.free_run(parameters, effects, values)[0]
    return {"parameters": found.x.tolist(), **leg.errors(run)}


def _start(name: str) -> float:
    return next(value for end, value in START.items() if name.endswith(end))
