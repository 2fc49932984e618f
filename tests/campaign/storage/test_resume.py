"""Campaigns that go on from their directory, as if they had never been left."""

import copy
import pickle

import pytest
import torch
from torch.distributions import Uniform

from sbi_active import Bank, BoxActions, Campaign, SimulatorModel
from sbi_active.campaign.storage.directory import is_mean
from sbi_active.simulation import reuse
from sbi_active.simulation.bank import LockedError
from tests.campaign.storage import campaigns
from tests.effects import BIAS
from tests.simulation.bank.filled import execute

CALLS = []  # sizes of what was simulated


def counted(theta, action):
    CALLS.append(len(theta))
    return campaigns.drawn(theta, action)


#: Simulators, and what else is given.
LEFT = [
    (campaigns.MODEL, {"method": "asbi"}),
    (campaigns.drawn, {"method": "nlhi"}),
    (campaigns.MODEL, {"options": {"max_simulations": 100, "planned_trials": 2}}),
]


@pytest.mark.parametrize(("simulator", "given"), LEFT)
def test_left_after_every_step(tmp_path, simulator, given):
    given = {"simulator": simulator, "actions": [0.5, 1.0, 2.0], **given}
    whole = campaigns.go_on(campaigns.new(**given), 2)

    campaign = campaigns.new(tmp_path / "c", **given)
    for index in range(2):
        action = campaign.ask().action
        campaign.close()
        campaign = Campaign.load(tmp_path / "c", simulator=simulator)
        assert torch.equal(campaign.pending.action, action)
        assert campaign.pending.design is not None
        campaign.tell(campaigns.outcome(action, index))
        campaign.close()
        campaign = Campaign.load(tmp_path / "c", simulator=simulator)
    campaign.update()
    campaign.close()
    campaign = Campaign.load(tmp_path / "c", simulator=simulator)

    assert torch.equal(campaigns.draws(campaign), campaigns.draws(whole))
    assert campaigns.facts(campaign) == campaigns.facts(whole)
    if whole.state.meter.limit is not None:
        assert campaign.state.meter.spent == whole.state.meter.spent


def test_what_follows_is_computed_again_from_the_log_without_simulating(tmp_path):
    whole = campaigns.go_on(campaigns.new(tmp_path / "c", simulator=counted), 2)
    whole.close()
    execute(tmp_path / "c", "DELETE FROM records WHERE kind IN ('state', 'belief')")
    CALLS.clear()

    campaign = Campaign.load(tmp_path / "c", simulator=counted)
    campaign.update()

    assert torch.equal(campaigns.draws(campaign), campaigns.draws(whole))
    assert campaigns.facts(campaign) == campaigns.facts(whole)
    assert not CALLS


def test_without_a_simulator_it_is_read_told_and_corrected(tmp_path):
    whole = campaigns.go_on(campaigns.new(tmp_path / "c"), 1)
    action = whole.ask().action
    whole.close()

    reader = Campaign.load(tmp_path / "c")
    assert torch.equal(campaigns.draws(reader), campaigns.draws(whole))
    assert reader.health == whole.health
    assert reader.pending.index == 1
    reader.tell(campaigns.outcome(action, 1))
    with pytest.raises(ValueError, match="pass it: Campaign.load"):
        reader.update()
    reader.correct(0, 2 * campaigns.outcome(action, 0), reason="gain of 2")
    assert reader.not_in_belief == [0, 1]  # which rests on what was told before
    assert "corrected since" in reader.belief.diagnostics.warnings[0]
    reader.close()

    whole = campaigns.new()
    for trial in reader.history:
        whole.attach(trial.action, trial.x)
    whole.update()
    again = Campaign.load(tmp_path / "c", simulator=campaigns.MODEL)
    again.update()
    assert torch.equal(campaigns.draws(again), campaigns.draws(whole))
    assert again.history[0].reason == "gain of 2"


def test_correct_and_withdraw_keep_the_old_lines_beside_a_pending_trial(tmp_path):
    campaign, x = campaigns.new(tmp_path / "c"), torch.tensor([0.3, 0.5, 0.7, 0.9])
    campaign.attach([1.0], x)
    campaign.attach([1.5], x)
    asked = campaign.ask()
    campaign.attach([2.0], status="invalid")
    assert campaign.pending.index == asked.index == 2
    campaign.correct(1, 100 * x, reason="told in m")
    campaign.correct(1, x, reason="it was cm")
    campaign.withdraw(0, reason="bumped into the table")
    assert campaign.withdraw(0).reason == "bumped into the table"
    campaign.close()

    lines = Campaign.load(tmp_path / "c").events
    events = [(line["event"], line["trial"]["reason"]) for line in lines]
    assert events[-3:] == [
        ("corrected", "told in m"),
        ("corrected", "it was cm"),
        ("withdrawn", "bumped into the table"),
    ]
    trials = Campaign.load(tmp_path / "c").state.trials
    assert [t.status for t in trials] == ["withdrawn", "ok", "pending", "invalid"]
    assert torch.equal(trials[1].x, x)
    assert trials[3].x.isnan().all()


def test_one_writer_any_number_of_readers(tmp_path):
    campaign = campaigns.go_on(campaigns.new(tmp_path / "c"), 1)
    other = Campaign.load(tmp_path / "c", simulator=campaigns.MODEL)
    assert torch.equal(campaigns.draws(other), campaigns.draws(campaign))
    with pytest.raises(LockedError, match="expected no other writer"):
        other.tell([0.0] * 4, action=[1.0])
    campaign.tell([0.3] * 4, action=[1.0])
    campaign.close()
    with pytest.raises(ValueError, match="load it again"):
        other.tell([0.0] * 4, action=[1.0])
    with Campaign.load(tmp_path / "c", simulator=campaigns.MODEL) as third:
        assert len(third.history) == 2


def test_a_new_campaign_wants_an_empty_directory(tmp_path):
    campaigns.new(tmp_path / "c").close()
    with pytest.raises(ValueError, match=r"go on by Campaign\.load"):
        campaigns.new(tmp_path / "c")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"with \['thesis\.tex'\]; choose another"):
        campaigns.new(tmp_path / "other")
    with pytest.raises(ValueError, match=r"expected a campaign; got no .*store\.db"):
        Campaign.load(tmp_path / "other")


@pytest.mark.parametrize("told_since", [False, True])
def test_another_simulator_is_refused_or_not_forgotten_by_a_kill(tmp_path, told_since):
    with campaigns.new(tmp_path / "c", simulator=campaigns.drawn) as campaign:
        campaign.attach([1.0], campaigns.outcome(torch.ones(1), 1))
        campaign.update()

    def mended(theta, action):
        return campaigns.drawn(theta, action) + 0.1

    with pytest.raises(ValueError, match="got another: simulator.*source"):
        Campaign.load(tmp_path / "c", simulator=mended)
    changed = Campaign.load(tmp_path / "c", simulator=mended, simulator_changed=True)
    if told_since:
        changed.attach([1.0], campaigns.outcome(torch.tensor([1.0]), 2))
    changed.close()  # as a kill before the next update: nothing was saved
    assert Campaign.load(tmp_path / "c", simulator=mended).state.is_stale
    anew = campaigns.new(simulator=mended)
    with Campaign.load(tmp_path / "c", simulator=mended) as campaign:
        campaign.update()
    for trial in campaign.history:
        anew.attach(trial.action, trial.x)
    anew.update()
    assert torch.equal(campaigns.draws(campaign), campaigns.draws(anew))
    again = Campaign.load(tmp_path / "c", simulator=mended)
    assert not again.state.is_stale  # the update after the change was saved
    assert torch.equal(campaigns.draws(again), campaigns.draws(anew))


def price(action):
    return 1 + action[:, 0]


class OwnPrior(Uniform):
    pass


def test_what_only_its_author_can_make_is_asked_for(tmp_path):
    prior = torch.distributions.Independent(OwnPrior(torch.zeros(2), torch.ones(2)), 1)
    given = {"prior": prior, "cost": price}
    campaign = campaigns.go_on(campaigns.new(tmp_path / "c", **given), 1)
    campaign.close()
    with pytest.raises(ValueError, match="expected prior=, which only its author"):
        Campaign.load(tmp_path / "c", simulator=campaigns.MODEL, cost=price)
    with pytest.raises(ValueError, match="expected prior=, which only its author"):
        Campaign.load(tmp_path / "c")
    reader = Campaign.load(tmp_path / "c", prior=prior)
    assert torch.equal(campaigns.draws(reader), campaigns.draws(campaign))
    with pytest.raises(ValueError, match=r"limits .*\['cost'\]; got \[\]"):
        Campaign.load(tmp_path / "c", simulator=campaigns.MODEL, prior=prior)
    again = Campaign.load(tmp_path / "c", simulator=campaigns.MODEL, **given)
    assert torch.equal(campaigns.draws(again), campaigns.draws(campaign))


def test_another_prior_or_space_is_refused(tmp_path):
    def of(kind, high):
        return torch.distributions.Independent(kind(torch.zeros(2), high), 1)

    own = of(OwnPrior, torch.ones(2))
    for name, prior in (("own", own), ("stored", campaigns.PRIOR)):
        campaigns.new(tmp_path / name, prior=prior).close()
        Campaign.load(tmp_path / name, prior=prior, actions=campaigns.ACTIONS)
        for another in (of(OwnPrior, 2 * torch.ones(2)), of(Uniform, torch.ones(2))):
            with pytest.raises(ValueError, match="the prior of the campaign; got an"):
                Campaign.load(tmp_path / name, prior=another)
        wider = BoxActions([0.5], [3.0], names=["speed"], units=["m/s"])
        with pytest.raises(ValueError, match="actions.high .2.0. there, .3.0. here"):
            Campaign.load(tmp_path / name, prior=prior, actions=wider)


def test_adopted_effects_come_back(tmp_path):
    campaign = campaigns.new(tmp_path / "c", simulator=campaigns.MODEL, effects=[BIAS])
    for index, action in enumerate(torch.linspace(0.5, 2.0, 3)):
        campaign.attach([float(action)], campaigns.outcome(action[None], index) + 0.5)
    report = campaign.criticize(evaluate=False)
    assert report.verdict == "bias"
    campaign.adopt(report)
    campaign.close()
    campaign.withdraw(campaign.attach([1.0], [0.5] * 4))  # who closed may go on
    campaign.close()

    reader = Campaign.load(tmp_path / "c")
    assert torch.equal(campaigns.draws(reader), campaigns.draws(campaign))
    assert reader.parameter_names == ["a", "b", "bias"]
    with pytest.raises(ValueError, match="expected the effects of .*, bias; got"):
        Campaign.load(tmp_path / "c", simulator=campaigns.MODEL)
    again = Campaign.load(tmp_path / "c", simulator=campaigns.MODEL, effects=[BIAS])
    assert again.state.version.effects == ("bias",)
    assert torch.equal(campaigns.draws(again), campaigns.draws(campaign))
    assert campaigns.draws(again).shape[1] == 3
    again.attach([1.0], campaigns.outcome(torch.tensor([1.0]), 7) + 0.5)
    again.update()
    assert again.history[-1].version == 1


def test_rows_of_a_campaign_are_used_again(tmp_path):
    with campaigns.new(tmp_path / "c", simulator=counted, method="asbi") as campaign:
        assert campaign.posterior is not None  # the first round's network
    reused = reuse(Bank(tmp_path / "c", name="drawn"), campaigns.PRIOR)
    worth = reused.effective_sample_size
    assert worth == pytest.approx(campaigns.OPTIONS.num_simulations)


def test_rows_are_kept_of_a_simulator_and_of_its_mean_alone():
    mean = copy.copy(campaigns.MODEL)
    mean.noise = None
    assert is_mean(mean, campaigns.MODEL)
    assert not is_mean(campaigns.drawn, campaigns.MODEL)
    drifting = SimulatorModel(campaigns.drawn)
    later = copy.copy(drifting)
    later.next_index = 3  # another simulator, with other rows
    assert not is_mean(later, drifting)


def test_a_pickled_copy_lives_in_memory(tmp_path):
    campaign = campaigns.go_on(campaigns.new(tmp_path / "c"), 1)
    copy = pickle.loads(pickle.dumps(campaign))
    copy.tell([0.1] * 4, action=[1.0])
    assert len(campaign.history) == 1
    assert len(Campaign.load(tmp_path / "c").history) == 1
