"""The figure of a campaign: what it draws, and that it stays readable."""

import matplotlib
import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
)
from sbi_active.campaign.display.predictions import predict
from sbi_active.campaign.state import Trial

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from .storage.campaigns import MODEL, OPTIONS, PRIOR, go_on, new

TRUTH = torch.tensor([0.3, 0.6])


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def campaign():
    return go_on(new(simulator=MODEL, method="asbi"), 3)


def panels(figure):
    """Return the axes of the beliefs, and the three below."""
    return [ax for ax in figure.axes if ax.axison][:-3], figure.axes[-3:]


def test_beliefs_are_the_quantiles_of_the_draws_with_the_truth(campaign):
    beliefs, _ = panels(campaign.plot(theta_true=TRUTH, num_predicted=0))
    assert len(beliefs) == 2
    for k, ax in enumerate(beliefs):
        median = ax.lines[0].get_xydata()
        assert median[:, 0].tolist() == [0, 1, 2, 3]
        draws = [campaign.state.draws[i][:, k].quantile(0.5) for i in range(3)]
        np.testing.assert_allclose(median[1:, 1], draws, rtol=1e-5)
        assert median[0, 1] == pytest.approx(0.5, abs=0.05)  # of the prior
        assert ax.lines[1].get_ydata()[0] == pytest.approx(float(TRUTH[k]))
        assert ax.get_title().startswith(f"{MODEL.parameter_names[k]}\n")


def test_below_stand_gain_prediction_and_information(campaign):
    _, (gain, outcome, information) = panels(campaign.plot(num_predicted=16))
    assert gain.get_xlabel() == "speed [m/s]"
    dots = [ln.get_xydata()[0] for ln in gain.lines if len(ln.get_xydata()) == 1]
    for trial, dot in zip(campaign.history, dots, strict=True):
        design = trial.design
        best = float(design.expected_information_gain[design.index])
        np.testing.assert_allclose(dot, [float(trial.action), best], rtol=1e-5)
    assert len(outcome.lines) == 3  # a cloud a trial, of four numbers
    assert [len(ln.get_xdata()) for ln in outcome.lines] == [4, 4, 4]
    heights = [bar.get_height() for bar in information.patches]
    gained = [t.information_gained for t in campaign.history]
    np.testing.assert_allclose(heights, gained)
    assert f"{sum(gained):.3g} nats" in information.get_title()


def test_predictions_are_of_the_belief_before_the_trial(campaign):
    found = predict(campaign.state, lambda index: MODEL, PRIOR, 200)
    assert [*found] == [0, 1, 2]
    action = float(campaign.history[0].action)
    # From the prior: a xi at time 0, with a uniform on [0, 1].
    first = found[0][:, 0]
    sd = (action**2 / 12 + 0.1**2) ** 0.5
    assert first.std() == pytest.approx(sd, rel=0.2)
    assert first.mean() == pytest.approx(action / 2, abs=4 * sd / 200**0.5)
    draws = campaign.state.draws[1]
    mean = float(draws[:, 0].mean() * campaign.history[2].action)
    assert found[2][:, 0].mean() == pytest.approx(mean, abs=4 * 0.15 / 200**0.5)


def test_no_prediction_of_a_model_with_other_parameters(campaign):
    wider = BoxUniform(torch.zeros(3), torch.ones(3))

    def simulator(theta, action):
        return MODEL(theta[:, :2], action)

    assert [*predict(campaign.state, lambda index: simulator, wider, 16)] == [0]


def test_looking_changes_nothing(campaign):
    before = torch.get_rng_state()
    numbers = [t.num_simulations for t in campaign.history]
    figures = [campaign.plot(num_predicted=8) for _ in range(2)]
    assert torch.equal(torch.get_rng_state(), before)
    assert numbers == [t.num_simulations for t in campaign.history]
    first, second = (figure.axes[-2].lines[0].get_xydata() for figure in figures)
    np.testing.assert_array_equal(first, second)


def test_without_the_simulator_there_are_surprises(tmp_path):
    c = go_on(new(tmp_path / "c", simulator=MODEL, method="asbi"), 1)
    c.close()
    _, (_, surprise, _) = panels(Campaign.load(tmp_path / "c").plot())
    assert surprise.lines[0].get_ydata()[0] == pytest.approx(c.history[0].surprise)


def test_a_new_campaign_and_a_random_one_have_a_figure():
    new(simulator=MODEL).plot().savefig("empty.png")
    c = go_on(new(simulator=MODEL, method="nsbi"), 1)
    _, (actions, _, _) = panels(c.plot(num_predicted=8))
    assert actions.lines[0].get_ydata()[0] == float(c.history[0].action)


def test_a_failed_trial_and_more_truths_than_parameters(campaign):
    c = new(simulator=MODEL)
    c.attach([1.0], status="invalid")
    c.attach([1.0], [0.1, 0.2, float("nan"), 0.3])
    c.update()
    c.plot(num_predicted=8).savefig("failed.png")
    with pytest.raises(ValueError, match="at most 2 numbers; got 3"):
        campaign.plot(theta_true=torch.zeros(3))


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
        trial = Trial(i, torch.ones(1), torch.linspace(0, 1, x), "ok")
        made.trials.append(trial)
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
            assert not (
                min(a.x1, b.x1) - max(a.x0, b.x0) > 1
                and min(a.y1, b.y1) - max(a.y0, b.y0) > 1
            )
    for k, ax in enumerate(beliefs):
        low, high = ax.get_ylim()
        last = made.draws[num_trials - 1][:, k].double().numpy()
        width = np.diff(np.quantile(last, [0.05, 0.95]))[0]
        assert width > 0.04 * (high - low)  # the last belief is no line
        assert low < 0.1 < high


def test_maps_stand_in_the_figure():
    model = SimulatorModel(
        lambda theta, action: theta * action[:, :1] + action[:, 1:],
        noise=GaussianNoise(0.1),
    )
    actions = BoxActions([0.5, 0.0], [2.0, 1.0], names=["speed", "tilt"])
    c = Campaign(model, PRIOR, actions, options=OPTIONS)
    c.ask()
    figure = c.plot()
    titles = [ax.get_title() for ax in figure.axes]
    assert "information by action, trial 0" in titles
