"""Ask, tell, update: the course of a campaign, its network, and what it refuses."""

import contextlib
import re

import numpy as np
import pytest
import torch
from attrs import evolve
from sbi.utils import BoxUniform
from torch.distributions import MultivariateNormal

from sbi_active.actions import DiscreteActions, SignalActions
from sbi_active.actions.waveforms import step
from sbi_active.campaign import Campaign, CampaignOptions, StopRules
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference.trainers import base
from sbi_active.messages import RenamedWarning
from sbi_active.simulation import SimulatorModel
from tests.campaign.problem import ACTIONS, OPTIONS, PRIOR, campaign, draws, noisy


def test_ask_tell_update():
    c = campaign("asbi", noisy, network="each round")
    trial = c.ask()
    assert repr(c) == "Campaign(asbi, 0 trials, one pending)"
    assert c.ask() is trial  # a pending trial is given again
    told = c.tell(torch.tensor([1.5]), action=[3.0])
    assert (told.status, told.x.tolist()) == ("ok", [1.5])
    assert c.belief is PRIOR  # tell only records
    belief = c.update()
    assert c.belief is belief
    assert belief.label == "refined"
    assert abs(float(belief.mean) - 0.5) < 0.1
    trial = c.history[0]
    assert trial.information_gained > 0.5
    stages = {"simulation", "training", "design", "scoring", "update"}
    assert {*trial.cpu_seconds} == stages
    spent = belief.diagnostics.num_simulations + OPTIONS.details.num_scored
    assert trial.num_simulations == 300 + trial.design.num_simulations + spent


def test_same_seed_same_campaign_whatever_the_global_generator():
    found = []
    for state in (1, 2):
        torch.manual_seed(state)
        np.random.seed(state)
        c = campaign("asbi", noisy, network="each round", given={"seed": 4})
        c.run(lambda action: 0.4 * action, num_rounds=2)
        found.append((float(c.belief.mean), [t.action.item() for t in c.history]))
    assert found[0] == found[1]


def run(mode):
    """Return actions, scores and draws of a campaign, all of it made in a mode."""
    with mode():
        prior = BoxUniform(torch.zeros(1), torch.ones(1))
        model = SimulatorModel(lambda t, a: t * a, noise=0.1)
        actions = DiscreteActions(torch.tensor([0.5, 1.0, 3.0]))
        options = evolve(OPTIONS, network="each round")
        c = Campaign(model, prior, actions, method="asbi", options=options)
        trial = c.ask()
        c.tell(torch.tensor([0.6]) * trial.action, trial=trial)
        c.attach([1.0], [0.6])
        c.update()
        c.criticize([], evaluate=False)
    trial = c.ask()  # and goes on outside
    torch.manual_seed(0)
    scores = [(t.surprise, t.log_score, t.information_gained) for t in c.history]
    return trial.action.tolist(), scores, c.belief.sample((20,)).tolist()


def test_numbers_are_the_same_without_gradients(few_draws):
    modes = (contextlib.nullcontext, torch.inference_mode)
    plain, other = (run(mode) for mode in modes)
    assert other == plain


def test_telling_is_idempotent_and_another_outcome_takes_its_place():
    c = campaign()
    trial = c.ask()
    first = c.tell([1.0], trial=trial)
    assert c.tell([1.0], trial=trial) is first
    assert c.tell(1.0, trial=0) is first
    assert c.tell(1.0) is first
    with pytest.raises(ValueError, match="expected a pending trial; got none"):
        c.tell(0.6)
    assert c.tell([2.0], trial=trial).x.tolist() == [2.0]
    assert len(c.history) == 1
    assert c.tell(2.0, action=first.action).index == 1  # a further one, by its action


def test_executed_actions_that_were_not_asked_for():
    c = campaign()
    trial = c.ask()
    with pytest.warns(UserWarning, match="not in Discrete.* simulated where it was"):
        told = c.tell([0.35], trial=trial, action=[0.7])
    assert told.action.tolist() == pytest.approx([0.7])
    assert abs(float(c.update().mean) - 0.5) < 0.15
    further = c.tell(np.array([1.5]), action=np.array([3.0]))
    assert (further.index, further.design) == (1, None)
    c.tell([0.5], action=[1.0])
    c.update()
    assert c.state.processed == [0, 1, 2]  # in order
    assert abs(float(c.belief.mean) - 0.5) < 0.1


def test_an_error_of_the_real_system_leaves_the_trial_pending():
    c = campaign()

    def broken(action):
        raise RuntimeError("the gripper is stuck")

    with pytest.raises(RuntimeError, match="gripper"):
        c.run(broken, num_rounds=1)
    assert c.pending is not None
    c.run(lambda action: 0.4 * action, num_rounds=1)
    assert len(c.history) == 1


def test_an_error_while_designing_loses_nothing():
    def fails_now(theta, action):
        raise RuntimeError("out of licenses")

    c = campaign("asbi", noisy)
    c.tell([0.5], action=[1.0])
    c.simulator = fails_now
    with pytest.raises(RuntimeError, match="licenses"):
        c.ask()
    assert c.pending is None
    assert c.history[0].x.tolist() == [0.5]
    c.simulator = noisy
    assert c.ask().status == "pending"


def test_other_errors():
    valid = "'asbi', 'nsbi', 'alhi', 'nlhi', 'seqbed'; got 'nre'"
    with pytest.raises(ValueError, match=re.escape(valid)):
        campaign("nre")
    with pytest.raises(ValueError, match="expected posterior 'importance' for ASBI"):
        campaign("asbi", details=CampaignDetails(posterior="kde"))
    with pytest.raises(ValueError, match="got identical x from two seeds"):
        Campaign(lambda t, a: t * a, PRIOR, ACTIONS)
    for effects in (["bias"], "bias"):
        with pytest.raises(TypeError, match="expected effects of class Effect; got '"):
            campaign(given={"effects": effects})
        with pytest.raises(TypeError, match="expected effects of class Effect; got '"):
            campaign().criticize(effects)  # pyright: ignore
    with pytest.raises(TypeError, match="expected options of a campaign; got 3"):
        CampaignOptions.of(3)


@pytest.mark.parametrize(
    ("max_sd", "stops"), [(0.11, False), ([0.11, 0.21], True), ([0.11, 0.19], False)]
)
def test_every_parameter_must_be_known_to_stop(max_sd, stops):
    belief = MultivariateNormal(torch.zeros(2), torch.tensor([0.01, 0.04]).diag())
    reason = StopRules(max_sd=max_sd).reason(belief, None, seed=0)
    assert (reason is not None) == stops
    with pytest.raises(ValueError, match="one for each of 2 parameters; got 3"):
        StopRules(max_sd=[1.0, 1.0, 1.0]).reason(belief, None, seed=0)


@pytest.mark.parametrize("scale", [1e-30, 1e20])
def test_narrow_and_wide_priors_that_float32_holds(scale):
    prior = BoxUniform(torch.zeros(1), scale * torch.ones(1))
    model = SimulatorModel(lambda t, a: t / scale * a, noise=0.1)
    c = Campaign(model, prior, ACTIONS, method="nsbi", options=OPTIONS)
    c.tell(1.8, action=[3.0])
    assert float(c.update().mean) / scale == pytest.approx(0.6, abs=0.05)


# When a round's network is trained, what asks it, and the posterior handed out


def test_asking_for_the_posterior_trains_it_and_changes_nothing_else():
    asked, other = campaign("asbi"), campaign("asbi")
    ahead = asked.posterior  # before any trial
    assert other.ask().num_simulations == asked.ask().num_simulations
    state = torch.get_rng_state()
    posterior = asked.posterior
    assert torch.equal(torch.get_rng_state(), state)
    x, action = torch.tensor([1.5]), torch.tensor([3.0])
    for model in (ahead, posterior):
        samples = model.sample((2_000,), x=x, action=action)
        assert float(samples.mean()) == pytest.approx(0.5, abs=0.15)
    for c in (asked, other):
        c.tell(torch.tensor([2.1]))
        c.update()
    assert torch.equal(draws(asked), draws(other))
    with pytest.warns(RenamedWarning, match="network_used_by goes in the next version"):
        assert asked.history[0].network_used_by == ()


# A campaign whose actions are signals that a robot plays


def test_signals_are_asked_for_and_learned_from():
    space = SignalActions(
        step("voltage", begin=0.1),
        [0.2, 0.05],
        [2.0, 0.8],
        input_times=torch.linspace(0, 1, 21),
        duration=0.7,
    )

    def follow(theta, action, *, inputs):
        return theta[:, :1] * inputs["voltage"] + theta[:, 1:]

    model = SimulatorModel(follow, noise=0.02, inputs=space)
    prior = BoxUniform(torch.tensor([1.0, -1.0]), torch.tensor([5.0, 1.0]))
    truth = torch.tensor([[3.0, 0.2]])
    c = Campaign(model, prior, space, options=OPTIONS)
    trial = c.ask()
    assert bool(space.contains(trial.action))
    for k, action in enumerate([trial.action, *space.sample((2,), seed=1)]):
        c.tell(model(truth, action[None], torch.tensor([k]))[0], action=action)
    c.update()
    mean, sd = c.belief.mean, c.belief.stddev
    assert bool(((mean - truth[0]).abs() < 4 * sd).all())
    assert bool((sd < 0.05).all())
    assert c.health == "ok"


# A campaign on parameters that no action tells apart


BOX = BoxUniform(torch.tensor([0.2, 0.2]), torch.tensor([1.0, 1.0]))
PUSHES = DiscreteActions([1.0, 2.0])


def force(theta, action):
    return action * theta[:, :1] * theta[:, 1:]


NAMES = ["friction", "mass"]
FORCE = SimulatorModel(force, noise=0.01, parameter_names=NAMES)


def test_what_is_said_outlives_the_process(tmp_path):
    options = CampaignOptions(network="on demand")
    given = {"options": options, "directory": tmp_path / "c"}
    with Campaign(FORCE, BOX, PUSHES, **given) as c:
        c.attach([2.0], [2 * 0.5 * 0.7])
        said = c.update().diagnostics.combinations  # pyright: ignore
    assert [found.text for found in said.known] == ["friction * mass"]
    assert [found.text for found in said.unknown] == ["friction / mass"]
    (known,) = said.known
    assert known.low - 0.02 < 0.35 < known.high + 0.02
    assert known.high - known.low < 0.1
    loaded = Campaign.load(tmp_path / "c", simulator=FORCE)
    assert repr(loaded) == "Campaign(asbi, 1 trials)"  # nothing was read yet
    assert loaded.belief.diagnostics.combinations == said  # pyright: ignore
    assert repr(loaded) == f"Campaign(asbi, 1 trials; {said})"


def test_a_search_begins_where_the_belief_before_the_trial_was(monkeypatch):
    """From the prior it missed a mode between jumps: a right simulator was blamed."""
    refine, started = base.refine, []

    def seen(*args, start, **kwargs):
        started.append([*start])
        return refine(*args, start=start, **kwargs)

    monkeypatch.setattr(base, "refine", seen)
    c = Campaign(FORCE, BOX, PUSHES, options=CampaignOptions(network="on demand"))
    beliefs = []
    for push in (2.0, 1.0):
        c.attach([push], [push * 0.5 * 0.7])
        beliefs.append(c.update())
    assert started == [[], beliefs[:1]]
