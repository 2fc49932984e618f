"""Forces that nobody declared, on a pendulum whose simulator takes ``force=``."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.forces import force_effects, total_force
from sbi_active.criticism.forces.dictionary import FORMS
from sbi_active.criticism.forces.library import trajectories
from sbi_active.criticism.rivals import coordinates

TIMES = torch.linspace(0.1, 2.0, 20, dtype=torch.float64)
STEP, SD, MASS = 0.05, 0.003, 2.0
PRIOR = BoxUniform(torch.tensor([5.0, 0.0]), torch.tensor([15.0, 1.0]))


def swing(theta, action, *, force=None):
    """A pendulum of inertia 2 under a torque of 3 rad/s, (n, 20) angles."""
    g, c = theta.double().T[..., None]
    q, u = action[:, :1].double().clone(), action[:, 1:].double()
    v, found = torch.zeros_like(q), []
    for k in range(40):
        t = k * STEP
        drive = u * np.sin(3 * t) - g * torch.sin(q) - c * v
        v = v + STEP * (drive + total_force(force, q, v, t)) / MASS
        q = q + STEP * v
        if k % 2:
            found.append(q[:, 0])
    return torch.stack(found, 1).to(theta.dtype)


MODEL = SimulatorModel(swing, noise=SD, sample_times=TIMES)


@dataclass(frozen=True)
class Hidden:
    """A force of an angle, which the truth has."""

    form: str

    def __call__(self, q, v, t, phi):
        return phi[:, :1] * FORMS[self.form][1](q, v, t, phi)


def measured(form="", size=0.0, seed=0):
    gen = torch.Generator().manual_seed(seed)
    start = torch.linspace(-1.2, 1.2, 10, dtype=torch.float64)
    start = start[torch.randperm(10, generator=gen)]
    push = 3 * torch.rand(10, generator=gen, dtype=torch.float64)
    action = torch.stack([start, push], 1)
    theta = torch.tensor([[9.0, 0.3]], dtype=torch.float64).expand(10, -1)
    force = {Hidden(form): torch.full((10, 1), size)} if form else None
    x = swing(theta, action, force=force)
    x = x + SD * torch.randn(x.shape, generator=gen, dtype=torch.float64)
    return Trials(action, x, sample_times=TIMES)


@pytest.fixture(scope="module")
def library():
    return force_effects(MODEL, PRIOR, measured(), joints=["hinge"])


def test_phi_of_one_is_a_fifth_of_the_force_of_nominal_motion(library):
    found = trajectories(MODEL, PRIOR, measured())
    acceleration = np.gradient(found.v, found.time, axis=1)
    expected = MASS * np.sqrt(np.mean(acceleration**2))  # by Newton
    assert found.force[0] == pytest.approx(expected, rel=0.05)
    for effect in library:
        if not effect.name.startswith(("q^3", "v|v|", "sin 6 pi t")):
            continue
        squares = []
        for k, t in enumerate(found.time):
            q, v = found.q[:, k], found.v[:, k]
            phi = np.tile([1.0, 0.5], (len(q), 1))
            squares.append(effect.apply.key(q, v, float(t), phi) ** 2)
        rms = np.sqrt(np.mean(squares))
        assert rms == pytest.approx(0.2 * found.force[0], rel=0.02)


def test_patterns_pick_effects():
    patterns = {"include": ("*v*", "t *"), "exclude": "free*"}
    some = force_effects(MODEL, PRIOR, measured(), joints=["hinge"], **patterns)
    assert "v|v| of hinge" in [e.name for e in some]
    assert not any(e.name.startswith("free") for e in some)
    with pytest.raises(ValueError, match="which matches none"):
        force_effects(MODEL, PRIOR, measured(), include="friction*")


def test_a_simulator_that_never_asks_is_refused():
    def fn(theta, action, *, force=None):
        return swing(theta, action)

    deaf = SimulatorModel(fn, noise=SD, sample_times=TIMES)
    with pytest.raises(ValueError, match="call total_force"):
        force_effects(deaf, PRIOR, measured())


# Forces whose sign would feed energy without bound are never fitted


@pytest.fixture(scope="module")
def pushed():
    """Return trials of a pendulum that something drives faster than it is damped."""
    return measured("v|v|", 0.2)


@pytest.fixture(scope="module")
def forces(pushed):
    effects = force_effects(MODEL, PRIOR, pushed, joints=["hinge"])
    return {effect.name: effect for effect in effects}


def test_only_what_outgrows_damping_and_drives_is_bounded(forces):
    bounds = {k: coordinates.dissipative_bounds(e) for k, e in forces.items()}
    for name in ("v|v| of hinge", "v^3 of hinge"):
        low, high = bounds.pop(name)
        assert low.tolist() == [-np.inf], name
        assert high.tolist() == [0.0], name
    assert not any(np.isfinite([*low, *high]).any() for low, high in bounds.values())


KINDS = [f"{form} of hinge" for form in ("v|v|", "v", "sin 2q", "q^3")]


@pytest.mark.parametrize("is_bounded", [True, False])
def test_damping_that_feeds_energy_is_never_adopted(
    is_bounded, pushed, forces, monkeypatch
):
    """Without the bound it is, so that these trials do speak for it."""
    if not is_bounded:
        everywhere = (np.full(1, -np.inf), np.full(1, np.inf))
        monkeypatch.setattr(coordinates, "dissipative_bounds", lambda e: everywhere)
    effects = [forces[name] for name in KINDS]
    tracing = Criticism(MODEL, PRIOR, pushed, effects=effects).trace()
    assert (KINDS[0] in tracing.chosen) != is_bounded
    for evidence in tracing.evidences.values():
        if is_bounded and KINDS[0] in evidence.names:
            at = evidence.names.index(KINDS[0])
            assert (evidence.draws[:, at] <= 1e-9).all()
