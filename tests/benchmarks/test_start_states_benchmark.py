"""The benchmark of start states: what cases are, and how they are counted."""

import pytest
import torch

from benchmarks.misfit.start_states import SENSOR, draw_case


def test_a_case_is_the_same_machine_with_and_without_a_hidden_force():
    bare, full = (draw_case(0, is_hidden=hidden) for hidden in (False, True))
    assert torch.equal(bare.theta, full.theta)
    assert (bare.name, bare.phi) == (full.name, full.phi)
    assert bare.size == 0
    moved = float((full.trials.x - bare.trials.x).square().mean().sqrt()) / SENSOR
    assert full.size == pytest.approx(moved)
    assert 1 < full.size < 40
    assert full.trials.x.shape == (12, 30)
