"""What tells one simulator from another."""

import importlib
import sys

import numpy as np
import pytest
import torch

from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.simulation.bank.fingerprint import differences, fingerprint

SLED = """
import functools

import numpy as np
import torch
from sled_constants import STIFFNESS

G = 9.81
SIZES = {"mass": 1.2, "wheels": (1, 2)}
TABLE = np.arange(40.0)
LIMIT = np.float32(3.0)
CALLS, CACHE, BUFFER = 0, {}, np.zeros(4)
SECOND = 1.0


def drag(v, power=2):
    return SIZES["mass"] * v**power + grip(v)


@functools.lru_cache
def grip(v):
    return SECOND


def slide(theta, action):
    global CALLS
    CALLS += 1
    CACHE[len(theta)] = TABLE.mean()
    BUFFER.fill(len(theta))
    each = [min(LIMIT, STIFFNESS) for _ in theta]
    return theta[:, :1] * G + drag(1.0) * action + each[0]


class Sled:
    def __call__(self, theta, action):
        return theta * G


def made(scale):
    def scaled(theta, action):
        return scale * theta * G

    return scaled
"""


@pytest.fixture
def sled(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "sled", raising=False)  # of another folder
    (tmp_path / "sled_constants.py").write_text("STIFFNESS = 4.0\n")
    (tmp_path / "sled.py").write_text(SLED)
    yield importlib.import_module("sled")
    for name in ("sled", "sled_constants"):
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("G", 9.8),
        ("SECOND", 1.5),  # of a function that a function calls
        ("STIFFNESS", 5.0),  # of another module, by name
        ("drag", lambda v, power=2: 0.0),
    ],
)
def test_a_changed_global_variable_is_another_simulator(sled, monkeypatch, name, value):
    model = SimulatorModel(sled.slide, noise=GaussianNoise(0.1))
    before = fingerprint(sled.slide), fingerprint(model)
    assert not differences(before[0], fingerprint(sled.slide))
    monkeypatch.setattr(sled, name, value)
    if name == "drag":
        value.__module__ = "sled"
    for found, simulator in zip(before, (sled.slide, model), strict=True):
        lines = differences(found, fingerprint(simulator))
        assert lines
        assert all(f"globals.{name}" in line for line in lines)


@pytest.mark.parametrize("of", [lambda m: m.Sled(), lambda m: m.made(2.0)])
def test_of_methods_and_inner_functions(sled, monkeypatch, of):
    before = fingerprint(of(sled))
    assert not differences(before, fingerprint(of(sled)))
    monkeypatch.setattr(sled, "G", 1.6)
    (line,) = differences(before, fingerprint(of(sled)))
    assert line.endswith("globals.G 9.81 there, 1.6 here")


def test_what_a_simulator_counts_and_keeps_is_no_setting(sled):
    before = fingerprint(sled.slide)
    sled.slide(torch.ones(3, 1), torch.ones(3, 1))
    assert sled.CALLS == 1
    assert sled.CACHE
    assert sled.BUFFER[0] == 3
    assert not differences(before, fingerprint(sled.slide))


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
    assert not differences(before, fingerprint(Rail(one)))
    (line,) = differences(before, fingerprint(Rail(other)))
    assert line.startswith("simulator.setting ")
