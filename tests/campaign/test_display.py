"""What a campaign shows: its table, its figure, the draws behind it, its progress."""

import copy
import logging
import pickle

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
    progress,
    to_inference_data,
)
from sbi_active.campaign.display.figures import predict
from sbi_active.campaign.health import health_by_trial
from sbi_active.campaign.state import CampaignState, ModelVersion, Trial

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from .storage.campaigns import MODEL, OPTIONS, PRIOR, go_on, new, outcome

TRUTH = torch.tensor([0.3, 0.6])
SOON = 0.05


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with two trials and a missing one; the third is pending."""
    path = tmp_path_factory.mktemp("shown") / "c"
    named = SimulatorModel(
        MODEL.fn,
        noise=MODEL.noise,
        parameter_names=["a", "b"],
        channel_names=["left", "right", "up", "down"],
    )
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
    assert frame.index.name == "trial"
    assert [*frame["status"]] == ["ok", "ok", "missing", "pending"]
    assert [*frame["target"]] == ["theta"] * 4
    assert not frame.columns.duplicated().any()
    for trial in campaign.state.trials:
        row = frame.loc[trial.index]
        assert row["speed [m/s]"] == float(trial.action)
        own = [row[name] for name in ("left", "right", "up", "down")]
        told = [np.nan] * 4 if trial.x is None else trial.x
        np.testing.assert_array_equal(np.float32(own), told)
        gain, error = trial.expected_gain
        assert row["expected_information"] == gain
        assert row["expected_information_error"] == error > 0
        assert row["seconds"] == sum(trial.seconds.values())
        for name in ("surprise", "information_gained", "log_score", "misfit"):
            value = getattr(trial, name)
            assert row[name] == value or (value is None and np.isnan(row[name]))
    assert frame["health"][1] == campaign.health == frame["health"][2] == "ok"
    assert pd.isna(frame["health"][3])
    assert frame.attrs["units"]["speed [m/s]"] == "m/s"
    assert frame.attrs["parameter_names"] == ["a", "b"]
    assert frame["surprise"].dtype == float


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


def test_health_is_that_of_then():
    """Three outcomes that nothing predicted raise the alarm; a new model ends it."""
    surprises = [0.5, 1e-3, 1e-3, 1e-3, 0.5]
    state = CampaignState("asbi", 0, CampaignOptions(), processed=[0, 1, 2, 3, 4, 5])
    for index, surprise in enumerate(surprises):
        trial = Trial(index, torch.zeros(1), torch.zeros(1), "ok")
        state.trials.append(trial)
        state.change(index, surprise=surprise, version=int(index == 4))
    state.trials.append(Trial(5, torch.zeros(1), torch.zeros(1), "ok"))
    state.versions.append(ModelVersion(1, ("bias",), trials=(0, 1, 2, 3)))
    found = health_by_trial(state)
    assert (found[0], found[3], found[4]) == ("ok", "alarm", "ok")
    assert 5 not in found  # it was not scored


def test_each_trial_leaves_draws_of_the_belief_after_it():
    c = go_on(new(simulator=MODEL), 2)
    belief, kept = c.belief, c.state.draws[1]
    assert kept.shape == (256, 2)
    sd = belief.variance.sqrt()
    assert ((kept.mean(0) - belief.mean).abs() / sd < 4 / 256**0.5).all()
    assert kept.std(0) == pytest.approx(sd, rel=0.25)
    before = dict(c.state.draws)
    c.correct(0, outcome(c.history[0].action, 7))
    c.update()
    after = c.state.draws
    assert [*after] == [0, 1]  # what is computed again is drawn again
    assert not any(torch.equal(before[i], after[i]) for i in before)
    c.withdraw(1)
    c.update()
    assert [*c.state.draws] == [0]


def test_beliefs_know_their_parameters(campaign):
    belief = campaign.belief
    assert belief.parameter_names == ("a", "b")
    assert "refined: a 0." in repr(belief)
    data = to_inference_data(belief, num_samples=10)
    assert [*data.posterior.parameter.values] == ["a", "b"]
    assert pickle.loads(pickle.dumps(belief)).parameter_names == ("a", "b")
    c = new(simulator=MODEL)
    c.attach([1.0], torch.full((4,), 1e4))
    with pytest.warns(UserWarning, match="range of the simulations"):
        c.update()
    assert c.belief.diagnostics.trustworthy is False
    assert c.belief.parameter_names == ("a", "b")


def panels(figure):
    """Return the axes of the beliefs, and the three below."""
    return [ax for ax in figure.axes if ax.axison][:-3], figure.axes[-3:]


def test_the_figure_has_beliefs_gain_prediction_and_information(campaign):
    figure = campaign.plot(theta_true=TRUTH, num_predicted=16)
    beliefs, (gain, told, information) = panels(figure)
    assert len(beliefs) == 2
    for k, ax in enumerate(beliefs):
        median = ax.lines[0].get_xydata()
        assert median[:, 0].tolist() == [0, 1, 2]
        draws = [campaign.state.draws[i][:, k].quantile(0.5) for i in range(2)]
        np.testing.assert_allclose(median[1:, 1], draws, rtol=1e-5)
        assert median[0, 1] == pytest.approx(0.5, abs=0.05)  # of the prior
        assert ax.lines[1].get_ydata()[0] == pytest.approx(float(TRUTH[k]))
        assert ax.get_title().startswith("ab"[k] + "\n")
    assert gain.get_xlabel() == "speed [m/s]"
    dots = [ln.get_xydata()[0] for ln in gain.lines if len(ln.get_xydata()) == 1]
    for trial, dot in zip(campaign.state.trials, dots, strict=True):
        best = trial.expected_gain[0]
        np.testing.assert_allclose(dot, [float(trial.action), best], rtol=1e-5)
    assert [len(ln.get_xdata()) for ln in told.lines] == [4, 4]
    heights = [bar.get_height() for bar in information.patches]
    gained = [t.information_gained for t in campaign.history[:2]]
    np.testing.assert_allclose(heights, gained)
    assert f"{sum(gained):.3g} nats" in information.get_title()
    with pytest.raises(ValueError, match="at most 2 numbers; got 3"):
        campaign.plot(theta_true=torch.zeros(3))


def test_predictions_are_of_the_belief_before_the_trial(campaign):
    found = predict(campaign.state, lambda index: MODEL, PRIOR, 200)
    assert [*found] == [0, 1]
    action = float(campaign.history[0].action)
    # From the prior: a xi at time 0, with a uniform on [0, 1].
    first = found[0][:, 0]
    sd = (action**2 / 12 + 0.1**2) ** 0.5
    assert first.std() == pytest.approx(sd, rel=0.2)
    assert first.mean() == pytest.approx(action / 2, abs=4 * sd / 200**0.5)
    draws = campaign.state.draws[0]
    mean = float(draws[:, 0].mean() * campaign.history[1].action)
    assert found[1][:, 0].mean() == pytest.approx(mean, abs=4 * 0.15 / 200**0.5)
    # Draws of a model with other parameters predict nothing.
    wider = BoxUniform(torch.zeros(3), torch.ones(3))
    simulator = lambda theta, action: MODEL(theta[:, :2], action)  # noqa: E731
    assert [*predict(campaign.state, lambda index: simulator, wider, 16)] == [0]


def test_looking_changes_nothing(campaign):
    before = torch.get_rng_state()
    numbers = [t.num_simulations for t in campaign.history]
    figures = [campaign.plot(num_predicted=8) for _ in range(2)]
    assert torch.equal(torch.get_rng_state(), before)
    assert numbers == [t.num_simulations for t in campaign.history]
    first, second = (figure.axes[-2].lines[0].get_xydata() for figure in figures)
    np.testing.assert_array_equal(first, second)


def test_empty_random_and_failed_campaigns_have_a_figure():
    new(simulator=MODEL).plot().savefig("empty.png")
    c = go_on(new(simulator=MODEL), 1)
    _, (actions, _, _) = panels(c.plot(num_predicted=8))
    assert actions.lines[0].get_ydata()[0] == float(c.history[0].action)
    c.attach([1.0], status="invalid")
    c.attach([1.0], [0.1, 0.2, float("nan"), 0.3])
    c.update()
    c.plot(num_predicted=8).savefig("failed.png")


@pytest.mark.parametrize(("dim", "num_trials", "x"), [(1, 1, 1), (20, 30, 100)])
def test_every_size_is_drawn_without_overlap(dim, num_trials, x):
    """Beliefs of made-up draws, each a third narrower than the one before."""
    prior = BoxUniform(-torch.ones(dim), torch.ones(dim))
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] * torch.linspace(0, 1, x) + action[:, :1],
        noise=GaussianNoise(0.1),
        parameter_names=[f"a_long_name_of_a_parameter_{i}" for i in range(dim)],
    )
    c = Campaign(model, prior, DiscreteActions([0.0, 1.0]), options=OPTIONS)
    made = c.state
    for i in range(num_trials):
        made.trials.append(Trial(i, torch.ones(1), torch.linspace(0, 1, x), "ok"))
        made.change(i, information_gained=0.3, surprise=0.5, version=0)
        made.processed.append(i)
        made.draws[i] = 0.1 + 0.66**i * torch.randn(64, dim) / 3
    figure = c.plot(theta_true=torch.full((dim,), 0.1), num_predicted=8)
    figure.canvas.draw()
    beliefs, _ = panels(figure)
    assert len(beliefs) == dim
    boxes = [ax.get_tightbbox() for ax in beliefs]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            wide = min(a.x1, b.x1) - max(a.x0, b.x0)
            high = min(a.y1, b.y1) - max(a.y0, b.y0)
            assert not (wide > 1 and high > 1)
    for k, ax in enumerate(beliefs):
        low, high = ax.get_ylim()
        last = made.draws[num_trials - 1][:, k].double().numpy()
        width = np.diff(np.quantile(last, [0.05, 0.95]))[0]
        assert width > 0.04 * (high - low)  # the last belief is no line
        assert low < 0.1 < high


@pytest.fixture
def said(monkeypatch, caplog):
    """Call long what takes a twentieth of a second, and return the log's lines."""
    monkeypatch.setattr(progress, "LONG", SOON)
    monkeypatch.setattr(progress, "SHOWN", SOON)
    monkeypatch.setattr(progress, "TICK", 0.01)
    caplog.set_level(logging.INFO, "sbi_active")
    return lambda: [r.getMessage() for r in caplog.records if r.name == "sbi_active"]


def test_bars_show_stages_and_rounds_where_they_are_asked_for(said, capsys, tmp_path):
    path = tmp_path / "c"
    with new(path, simulator=MODEL, show_progress=True) as c:
        c.run(lambda action: outcome(action, 0), num_rounds=2)
        twin = copy.deepcopy(c)
    assert twin.state.show_progress
    shown = capsys.readouterr().err
    for part in ("rounds: 100%", "2/2", "trial 0: update: 00:00", "of about"):
        assert part in shown  # the second update knows of the first
    with Campaign.load(path, simulator=MODEL) as loaded:
        go_on(loaded, 3)
    assert capsys.readouterr().err == ""
