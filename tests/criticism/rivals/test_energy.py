"""Forces whose sign would feed energy without bound are never fitted."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.forces import force_effects, total_force
from sbi_active.criticism.rivals import coordinates
from sbi_active.criticism.rivals.coordinates import dissipative_bounds

STEP, NUM = 0.02, 100


def swing(theta, action, *, force=None):
    """Return a damped pendulum's angle, (n, k)."""
    q, v, found = action[:, :1].clone(), torch.zeros(len(action), 1), []
    v = v.to(q)
    for k in range(NUM):
        tau = total_force(force, q, v, STEP * k)
        v = v + STEP * (tau - 9.81 * torch.sin(q) - theta * v)
        q = q + STEP * v
        found.append(q[:, 0])
    return torch.stack(found, 1)


TIMES = STEP * torch.arange(1, NUM + 1, dtype=torch.float64)
PRIOR = BoxUniform(torch.zeros(1), 2 * torch.ones(1))


def model(sd):
    return SimulatorModel(swing, noise=GaussianNoise(sd), sample_times=TIMES)


@pytest.fixture(scope="module")
def pushed():
    """Return trials of a pendulum that something drives faster than it is damped."""
    action = torch.tensor([[0.3], [0.6], [0.9], [1.2], [-0.5], [-1.0], [1.5]])

    class Push:
        def __call__(self, q, v, t, phi):
            return 0.15 * v * np.abs(v)

    force = {Push(): torch.zeros(len(action), 1)}
    x = swing(torch.full((len(action), 1), 0.6), action.double(), force=force)
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    return Trials(action, x + 0.003 * noise, sample_times=TIMES)


@pytest.fixture(scope="module")
def forces(pushed):
    effects = force_effects(model(0.003), PRIOR, pushed, joints=["hinge"])
    return {effect.name: effect for effect in effects}


def test_only_what_outgrows_damping_and_drives_is_bounded(forces):
    bounds = {name: dissipative_bounds(effect) for name, effect in forces.items()}
    for name in ("v|v| of hinge", "v^3 of hinge"):
        low, high = bounds[name]
        assert low.tolist() == [-np.inf], name
        assert high.tolist() == [0.0], name
    rest = {n for n, (low, high) in bounds.items() if np.isfinite([*low, *high]).any()}
    assert rest == {"v|v| of hinge", "v^3 of hinge"}


KINDS = [f"{form} of hinge" for form in ("v|v|", "v", "sin 2q", "q^3")]
FREE = pytest.param(False, marks=pytest.mark.slow)


@pytest.mark.parametrize("is_bounded", [True, FREE])
def test_damping_that_feeds_energy_is_never_adopted(
    is_bounded, pushed, forces, monkeypatch
):
    if not is_bounded:
        everywhere = (np.full(1, -np.inf), np.full(1, np.inf))
        monkeypatch.setattr(coordinates, "dissipative_bounds", lambda e: everywhere)
    effects = [forces[name] for name in KINDS]
    tracing = Criticism(model(0.003), PRIOR, pushed, effects=effects).trace()
    assert (KINDS[0] in tracing.chosen) != is_bounded
    for evidence in tracing.evidences.values():
        if is_bounded and KINDS[0] in evidence.names:
            at = evidence.names.index(KINDS[0])
            assert (evidence.draws[:, at] <= 1e-9).all()
