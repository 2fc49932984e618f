"""Numbers as users bring them."""

import re

import numpy as np
import pytest
import torch

from sbi_active.arrays import measured, own_tensor

MASKED = np.ma.masked_array([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize(
    "given",
    [
        (1.0, np.float64(2.0)),
        [torch.tensor(1.0), 2.0],
        np.array([1, 2], dtype=">i2"),
        np.array([1, 2], dtype=object),
        torch.tensor([1.0, 2.0], requires_grad=True),
    ],
)
def test_numbers_of_any_kind(given):
    assert measured(given).dtype == torch.float64
    assert measured(given).tolist() == [1.0, 2.0]
    assert not measured(given).requires_grad


@pytest.mark.parametrize("make", [torch.as_tensor, np.asarray, lambda rows: rows[:]])
@pytest.mark.parametrize("dtype", [None, torch.float32, torch.float64])
def test_a_copy_is_taken_of_views_too(make, dtype):
    given = make([3.0, 1.0, 2.0])
    own = own_tensor(given[1:], dtype)
    given[1] = 7.0
    assert own.tolist() == [1.0, 2.0]


def test_what_is_masked_or_none_is_nan():
    for given in (MASKED, [1.0, None], np.array([1.0, None], dtype=object)):
        assert measured(given).isnan().tolist() == [False, True]


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("1.5", "expected speed of real numbers; got '1.5'"),
        ([[1.0], [2.0, 3.0]], "with rows of one length"),
    ],
)
def test_what_is_no_real_number_is_refused(given, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        measured(given, name="speed")
