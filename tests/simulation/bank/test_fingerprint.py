"""What tells one simulator from another."""

import functools

import numpy as np
import pytest
import torch

from sbi_active import SimulatorModel
from sbi_active.simulation.fingerprint import fingerprint, require_same


class Rail:
    def __init__(self, setting):
        self.setting = setting

    def __call__(self, theta, action):
        return theta


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.float32(1.0), np.float32(2.0)),
        ({"ice"}, {"ice", "steel"}),
        (1j, 2j),
        (b"a", b"b"),
        (torch.ones(2, dtype=torch.bfloat16), torch.zeros(2, dtype=torch.bfloat16)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_settings_of_any_kind_are_seen(one, other):
    before = fingerprint(Rail(one))
    require_same("it", before, fingerprint(Rail(one)))
    with pytest.raises(ValueError, match="another: simulator.setting "):
        require_same("it", before, fingerprint(Rail(other)))


def made(scale, power=2):
    def scaled(theta, action, shift=0.0):
        return scale * theta**power + shift

    return scaled


@pytest.mark.parametrize("other", [made(3.0), made(2.0, power=3), Rail(made(2.0))])
def test_captured_variables_and_parts_are_seen(other):
    before = fingerprint(made(2.0))
    require_same("it", before, fingerprint(made(2.0)))
    with pytest.raises(ValueError, match="got another"):
        require_same("it", before, fingerprint(other))


@pytest.mark.parametrize("of", [lambda f: f, Rail, lambda f: Rail(f).__call__])
def test_defaults_partial_functions_and_methods(of):
    def pushed(theta, action, force=1.0):
        return theta

    whole, part = of(pushed), of(functools.partial(pushed, force=2.0))
    before = [fingerprint(simulator) for simulator in (whole, part)]
    for k, value in enumerate((whole, part)):
        require_same("it", before[k], fingerprint(value))
    other = of(functools.partial(pushed, force=3.0))
    pushed.__defaults__ = (1.5,)
    for k, value in enumerate((whole, other)):
        with pytest.raises(ValueError, match="got another"):
            require_same("it", before[k], fingerprint(value))


def test_source_of_the_library_changes_from_release_to_release():
    model = SimulatorModel(Rail(1.0))
    before = fingerprint(model)
    before["simulator"]["source"] = "that of another release"
    require_same("it", before, fingerprint(model))
