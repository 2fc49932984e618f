"""What a campaign shows: its table, its figure, the draws behind it, its progress."""

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active import Campaign, DiscreteActions, SimulatorModel

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from .storage.campaigns import MODEL, OPTIONS, PRIOR, go_on


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with two trials and a missing one; the third is pending."""
    path = tmp_path_factory.mktemp("shown") / "c"
    names = {"parameter_names": ["a", "b"]}
    names |= {"channel_names": ["left", "right", "up", "down"]}
    named = SimulatorModel(MODEL.fn, noise=MODEL.noise, **names)
    speeds = DiscreteActions([0.5, 1.0, 2.0], names=["speed"], units=["m/s"])
    with go_on(Campaign(named, PRIOR, speeds, options=OPTIONS, directory=path), 2) as c:
        c.ask()
        c.tell(status="missing")
        c.update()
        c.ask()
    return path, c


@pytest.fixture(scope="module")
def campaign(folder):
    return folder[1]


def test_a_row_is_a_trial(campaign):
    frame = campaign.to_dataframe()
    assert [*frame.index] == [0, 1, 2, 3]
    assert [*frame["status"]] == ["ok", "ok", "missing", "pending"]
    for trial in campaign.state.trials:
        row = frame.loc[trial.index]
        assert row["speed [m/s]"] == float(trial.action)
        own = [row[name] for name in ("left", "right", "up", "down")]
        told = [np.nan] * 4 if trial.x is None else trial.x
        np.testing.assert_array_equal(np.float32(own), told)
        assert row["expected_information"] == trial.expected_gain[0]
        for name in ("surprise", "information_gained", "log_score", "misfit"):
            value = getattr(trial, name)
            assert row[name] == value or (value is None and np.isnan(row[name]))
    assert [*frame["health"][:3]] == ["ok"] * 3
    assert pd.isna(frame["health"][3])
    assert frame.attrs["units"]["speed [m/s]"] == "m/s"


def test_table_draws_and_names_are_the_same_without_the_simulator(folder):
    path, campaign = folder
    loaded = Campaign.load(path)
    pd.testing.assert_frame_equal(loaded.to_dataframe(), campaign.to_dataframe())
    again, kept = loaded.state.draws, campaign.state.draws
    assert [*again] == [*kept] == [0, 1]  # a missing trial leaves none
    assert all(torch.equal(again[i], kept[i]) for i in kept)
    assert loaded.belief.parameter_names == ("a", "b")
    figure = loaded.plot()
    surprise = figure.axes[-2].lines[0].get_ydata()[0]
    assert surprise == pytest.approx(campaign.history[0].surprise)
