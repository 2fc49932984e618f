import numpy as np
import pytest
import torch

from benchmarks.pouring.bank import LIKELY, ROWS_A_FILE, draw
from benchmarks.pouring.likelihood import (
    repeated,
)
from sbi_active.tasks import get_task  # pyright: ignore


def test_a_repeat_tells_less_than_a_first_pour():
    mean, error, noise = np.array([[0.0]]), np.array([[0.04]]), np.array([[1.0]])
    first = repeated(mean, error, noise, [], 0.2)
    assert first[0] == 0
    assert first[1] == pytest.approx(np.sqrt(1.04))
    # The error that repeats share: exact for normal variables.
    earlier = [np.array([0.5]), np.array([1.5])]
    common, alone = 0.24, 0.8
    cover = common + alone * np.eye(3)
    known = cover[2, :2] @ np.linalg.inv(cover[:2, :2])
    moved = repeated(mean, error, noise, earlier, 0.2)
    assert moved[0] == pytest.approx(known @ [0.5, 1.5])
    assert moved[1] ** 2 == pytest.approx(cover[2, 2] - known @ cover[:2, 2])
    # Without anything in common, earlier pours of the action change nothing.
    same = repeated(mean, 0 * error, noise, earlier, 0.0)
    assert same[0] == 0
    assert same[1] == 1


def test_a_bank_is_drawn_by_the_number_of_its_file():
    pytest.importorskip("pybullet")
    task = get_task("pouring")
    assert len(draw(task, "likely", 0).action.unique(dim=0)) == len(LIKELY)
    first, again = draw(task, "prior", 0).theta, draw(task, "prior", 0).theta
    assert torch.equal(first, again)
    assert len(first.unique(dim=0)) == ROWS_A_FILE
