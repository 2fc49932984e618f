"""A ``residual_fn`` of ``mujoco.sysid`` as it is, as a deterministic simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.mujoco.models.parameters import Bounded
from sbi_active.mujoco.robot import Robot, named_box
from sbi_active.simulation import SimulatorModel


def free_parameters(params: Any) -> tuple[Bounded, ...]:
    """Return names and bounds of the parameters of a ``ParameterDict`` not frozen.

    Raises:
        ValueError: If there is none, or bounds are not finite and in order.
    """
    names = params.get_non_frozen_parameter_names()
    if not names:
        raise ValueError(
            "expected a parameter that is not frozen; got none; free the unknown ones"
        )
    each = zip(names, *params.get_bounds(), strict=True)
    return tuple(Bounded(name, float(low), float(high)) for name, low, high in each)


def from_residuals(residual_fn: Any, params: Any, *, noise: Any) -> Robot:
    """Return a robot whose outcome is minus the residual of each sequence.

    It runs in this process, since a spec is not sent to others.

    Args:
        residual_fn: ``residual_fn(x, params)`` of ``build_residual_fn``.
        params: A ``ParameterDict``.
        noise: Noise of the residuals.

    Raises:
        ValueError: If there is no noise.
    """
    if noise is None:
        raise ValueError(
            "expected the noise of residuals; got none; pass noise=, in their units"
        )
    declared = free_parameters(params)
    function = _Residuals(residual_fn, params.copy())
    middle = np.array([0.5 * (p.low + p.high) for p in declared])
    lengths = [len(r) for r in function.each(middle)]
    function.length = max(lengths)
    number = torch.arange(len(lengths), dtype=torch.float32)[:, None]
    x = [np.zeros(k) for k in lengths]
    simulator = SimulatorModel(
        function, noise=noise, parameter_names=[p.name for p in declared]
    )
    actions = DiscreteActions(number, names=["recording"])
    trials = Trials(number, x, action_labels=["recording"])
    return Robot(simulator, named_box(declared), actions, trials)


class _Residuals:
    """Minus the residuals of one sequence a row."""

    length = 0

    def __init__(self, residual_fn: Any, params: Any) -> None:
        self.residual_fn, self.params = residual_fn, params

    def each(self, theta: Array) -> list[Array]:
        """Return the residuals of all sequences, one array each."""
        found, *_ = self.residual_fn(theta, self.params)
        return [np.asarray(r, dtype=float).reshape(-1) for r in found]

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return minus the residuals, shape (n, length), NaN where there is none.

        Args:
            theta: Parameters, shape (n, d).
            action: Numbers of sequences, shape (n, 1).
        """
        rows = theta.detach().cpu().double().numpy()
        number = action[:, 0].round().long().tolist()
        x = np.full((len(rows), self.length), np.nan)
        known: dict[bytes, list[Array]] = {}
        for i, row in enumerate(rows):
            key = row.tobytes()
            if key not in known:
                known[key] = self.each(row.copy())
            own = known[key][number[i]]
            x[i, : len(own)] = -own
        return torch.from_numpy(x).to(theta.dtype)
