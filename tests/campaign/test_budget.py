"""Trials that cost, what is left for them, and two of them planned together."""

import json

import pytest
import torch
from attrs import evolve
from torch.distributions import MultivariateNormal

from sbi_active import BoxActions, Campaign, DiscreteActions, SimulatorModel, StopRules
from sbi_active.campaign.options import CampaignDetails
from sbi_active.cli.record import Record, answer_of, sum_up_campaign
from tests.campaign.problem import ACTIONS, MODEL, OPTIONS, campaign


def pay(action):
    return action[:, 0].double()


def travel(action, previous):
    start = torch.zeros(1) if previous is None else previous
    return 1 + (action[:, 0] - start[0]).abs().double()


def within(budget, cost=pay, method="nsbi", **more):
    return campaign(method, given={"cost": cost, **more}, stop=StopRules(budget=budget))


def test_a_campaign_ends_when_what_is_left_affords_no_action():
    c = within(4.2)
    c.run(lambda action: 0.5 * action, num_rounds=20)
    assert 4.2 - 0.5 < c.state.spent <= 4.2
    assert c.state.spent == sum(float(t.action) for t in c.history)
    assert c.state.left == pytest.approx(4.2 - c.state.spent)
    assert c.pending is None
    assert "affords no permitted action" in c.stop_reason
    assert f"{c.state.spent:.4g} of 4.2 spent" in repr(c)
    assert c.to_dataframe()["cost"].tolist() == [t.cost for t in c.history]
    with pytest.raises(ValueError, match="budget is spent.*larger budget"):
        c.ask()


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
@pytest.mark.parametrize("actions", [ACTIONS, BoxActions([0.5], [3.0])])
def test_no_action_costs_more_than_what_is_left(method, actions):
    options = evolve(OPTIONS, stop=StopRules(budget=1.5))
    c = Campaign(MODEL, prior_of(1), actions, method=method, cost=pay, options=options)
    for _ in range(3):
        if c.stop_reason is None:
            trial = c.ask()
            assert float(trial.action) <= c.state.left + 1e-5
            c.tell(0.5 * trial.action)
    assert 0 < c.state.spent <= 1.5 + 1e-5


def prior_of(dim):
    return MultivariateNormal(torch.zeros(dim), torch.eye(dim))


def test_without_a_cost_the_budget_is_a_number_of_trials():
    c = campaign("nsbi", stop=StopRules(budget=2))
    c.run(lambda action: 0.5 * action, num_rounds=5)
    assert len(c.history) == 2
    plain = campaign("nsbi")
    plain.tell(0.5, action=[1.0])
    assert plain.history[0].cost is None
    assert "spent" not in repr(plain)


def test_costs_that_add_up_to_the_budget_in_float32_are_afforded():
    given = {"cost": lambda action: action[:, 0]}
    tenths = DiscreteActions([0.1])
    c = campaign(actions=tenths, given=given, stop=StopRules(budget=1.0))
    c.run(lambda action: 0.5 * action, num_rounds=20)
    assert len(c.history) == 10


def test_the_executed_action_is_paid_also_for_what_is_lost():
    c = within(20.0, travel)
    c.ask()
    c.tell(0.5, action=[1.0])
    assert c.state.spent == 2.0
    c.tell(1.0, action=[3.0])
    c.tell(action=[2.0], status="missing")
    assert [t.cost for t in c.history] == [2.0, 3.0, 2.0]
    c.withdraw(1)
    assert c.state.spent == 7.0
    c.correct(0, action=[3.0])  # the next one had no way to go
    assert [t.cost for t in c.history] == [4.0, 1.0, 2.0]


def test_a_pending_trial_that_others_left_no_budget_for_is_not_run():
    c = within(4.0)
    c.ask()
    assert c.stop_reason is None
    c.attach([3.9], 1.9)
    c.run(lambda action: pytest.fail("not afforded"), num_rounds=3)
    assert c.pending is not None


def test_resume_keeps_what_is_spent(tmp_path):
    folder = tmp_path / "c"
    c = within(20.0, travel, directory=folder)
    c.tell(1.5, action=[3.0])
    c.tell(0.5, action=[1.0])
    c.update()
    c.close()
    again = Campaign.load(folder, simulator=MODEL, cost=travel)
    assert (again.state.spent, again.state.left) == (7.0, 13.0)
    action = again.ask().action
    sum_up_campaign(again)
    again.close()
    reader = Campaign.load(folder)
    assert reader.state.spent == 7.0
    for source in (reader, Record(folder)):
        answer = answer_of(source)
        data = json.loads(json.dumps(answer.data))
        assert (data["spent"], data["left"]) == (7.0, 13.0)
        assert [t["cost"] for t in data["trials"]] == [4.0, 3.0, None]
        assert "7 spent, 13 left" in answer.text
    reader.tell(0.5)  # the function that says what it costs is not here
    assert reader.state.spent is None
    assert reader.state.left is None
    assert "an unknown cost of 20 spent" in repr(reader)
    answer_of(reader)
    reader.close()
    whole = Campaign.load(folder, simulator=MODEL, cost=travel)
    assert whole.state.spent == 7.0 + float(travel(action[None], torch.ones(1)))


# Two far places of two measurements each, on both sides of a near and poor one

PLACES = torch.tensor([0.0, -1.0, -1.0, 1.0, 1.0])
SCALES = torch.tensor([3.0, 100.0, 100.0, 100.0, 100.0]).sqrt()
MEASURED = DiscreteActions(torch.arange(5.0))
TRUTH = torch.tensor([[0.5, -0.5, 0.2, 0.8, -1.0]])


def trip(action, previous):
    """Cost of 1 a trial and 4 a unit of way, from 0 on."""
    here = 0.0 if previous is None else PLACES[int(previous)]
    return 1 + 4 * (PLACES[action[:, 0].long()] - here).abs()


def measure(theta, action):
    """Each action measures a parameter of its own."""
    index = action[:, :1].long()
    return SCALES[index] * theta.gather(1, index)


def information(history):
    r"""Exact information, nats: half of the sum of :math:`\log(1 + n_k s_k^2)`."""
    index = torch.stack([t.action[0].long() for t in history])
    count = torch.bincount(index, minlength=5)
    return float((count * SCALES**2).log1p().sum() / 2)


def test_pairs_tell_more_than_single_trials_for_the_same_budget():
    told = {}
    for look_ahead in (1, 2):
        details = CampaignDetails(num_scored=100, look_ahead=look_ahead)
        sizes = {"num_samples": 64, "details": details}
        options = evolve(OPTIONS, stop=StopRules(budget=6.0), **sizes)
        model = SimulatorModel(measure, noise=1.0)
        c = Campaign(model, prior_of(5), MEASURED, cost=trip, options=options)
        c.run(lambda action: measure(TRUTH, action[None])[0], num_rounds=20)
        assert c.state.spent <= 6.0
        told[look_ahead] = information(c.history)
    assert [t.cost for t in c.history] == [5.0, 1.0]
    assert told[2] == pytest.approx(torch.tensor(101.0).log().item())
    assert told[1] < told[2] - 1.5
    assert "], then [" in c.history[0].design.notes[-1]
