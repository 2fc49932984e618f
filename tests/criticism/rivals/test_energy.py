"""Forces whose sign would feed energy without bound are never fitted."""

import numpy as np
import pytest

from sbi_active.criticism import Criticism
from sbi_active.criticism.forces import force_effects
from sbi_active.criticism.rivals import coordinates
from sbi_active.criticism.rivals.coordinates import dissipative_bounds
from tests.criticism.forces.test_forces import MODEL, PRIOR, measured


@pytest.fixture(scope="module")
def pushed():
    """Return trials of a pendulum that something drives faster than it is damped."""
    return measured("v|v|", 0.2)


@pytest.fixture(scope="module")
def forces(pushed):
    effects = force_effects(MODEL, PRIOR, pushed, joints=["hinge"])
    return {effect.name: effect for effect in effects}


def test_only_what_outgrows_damping_and_drives_is_bounded(forces):
    bounds = {name: dissipative_bounds(effect) for name, effect in forces.items()}
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
