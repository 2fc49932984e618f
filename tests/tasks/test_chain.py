"""The chain against an ODE solver, and its options."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sbi_active.tasks import get_task
from sbi_active.tasks.chain import model


@pytest.mark.parametrize(("parameters", "moving"), [(5, 3), (6, 2)])
def test_the_closed_form_solves_the_equations(parameters, moving):
    task = get_task("chain", parameters=parameters)
    theta, count = task.theta_true.double(), model.num_masses(parameters)
    k = theta[:count].numpy()
    m = np.append(theta[count:].numpy(), [1.0] * (2 * count - parameters))[:moving]
    right = np.append(k[1:], 0.0)[:moving]
    stiffness = np.diag(k[:moving] + right)
    off = k[1:moving]
    stiffness -= np.diag(off, 1) + np.diag(off, -1)
    root = np.diag(m**-0.5)
    square, mode = np.linalg.eigh(root @ stiffness @ root)
    damping = mode @ np.diag(2 * model.DAMPING * np.sqrt(square)) @ mode.T
    damping = np.diag(m**0.5) @ damping @ np.diag(m**0.5)

    def rate(t, state):
        y, v = np.split(state, 2)
        force = np.zeros(moving)
        force[0] = model.FORCE * np.sin(13.0 * t)
        return np.concatenate([v, (force - stiffness @ y - damping @ v) / m])

    times = model.SAMPLE_TIMES.numpy()
    tight = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
    solved = solve_ivp(rate, (0, 2.0), np.zeros(2 * moving), t_eval=times, **tight)
    action = torch.tensor([[13.0, float(moving)]])
    found = model.mean(theta[None], action)[0].numpy()
    assert found[:moving] == pytest.approx(solved.y[:moving], abs=1e-7)
    assert (found[moving:] == 0).all()
