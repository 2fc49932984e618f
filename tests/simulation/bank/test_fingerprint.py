"""What tells one simulator from another."""

from functools import partial

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


def made(scale, power=2):
    def scaled(theta, action, shift=0.0):
        return scale * theta**power + shift

    return scaled


@pytest.mark.parametrize(
    ("make", "one", "other"),
    [
        (Rail, np.float32(1.0), np.float32(2.0)),
        (Rail, {"ice"}, {"ice", "steel"}),
        (Rail, 1j, 2j),
        (Rail, b"a", b"b"),
        (Rail, torch.ones(2).bfloat16(), torch.zeros(2).bfloat16()),
        (made, 2.0, 3.0),
        (partial(made, 2.0), 2, 3),
    ],
)
def test_settings_and_captured_variables_of_any_kind_are_seen(make, one, other):
    before = fingerprint(make(one))
    require_same("it", before, fingerprint(make(one)))
    text = "another: simulator.setting " if make is Rail else "got another"
    with pytest.raises(ValueError, match=text):
        require_same("it", before, fingerprint(make(other)))


@pytest.mark.parametrize("of", [lambda f: f, Rail, lambda f: Rail(f).__call__])
def test_defaults_partial_functions_and_methods(of):
    def pushed(theta, action, force=1.0):
        return theta

    whole, part = of(pushed), of(partial(pushed, force=2.0))
    before = [fingerprint(simulator) for simulator in (whole, part)]
    for k, value in enumerate((whole, part)):
        require_same("it", before[k], fingerprint(value))
    other = of(partial(pushed, force=3.0))
    pushed.__defaults__ = (1.5,)
    for k, value in enumerate((whole, other)):
        with pytest.raises(ValueError, match="got another"):
            require_same("it", before[k], fingerprint(value))


def test_source_of_the_library_changes_from_release_to_release():
    model = SimulatorModel(Rail(1.0))
    before = fingerprint(model)
    before["simulator"]["source"] = "that of another release"
    require_same("it", before, fingerprint(model))
