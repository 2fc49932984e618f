"""Warnings point at the user's line, from however deep."""

import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.data.tables import read_trials


def read_two_deep(path):
    return read_trials(path)


@pytest.mark.parametrize("read", [Trials.from_csv, read_trials, read_two_deep])
def test_a_warning_of_a_table_points_at_who_read_it(read, tmp_path):
    file = tmp_path / "trials.csv"
    file.write_text("action_speed,x_place\n1,0.1\n2,\n")
    for path in (file, tmp_path):
        with pytest.warns(UserWarning, match="1 of 2 cells") as noted:
            read(path)
        assert [note.filename for note in noted] == [__file__]


def test_a_warning_of_an_array_points_at_who_passed_it():
    with pytest.warns(UserWarning, match="x is inf") as noted:
        Trials([1.0, 2.0], torch.tensor([1.0, torch.inf]))
    assert noted[0].filename == __file__
