"""What a campaign's next trial is for, when it stops, and adopting another model."""

import warnings

import cloudpickle
import pytest
import torch
from attrs import evolve
from sbi.utils import BoxUniform

from sbi_active import Campaign, DiscreteActions, MixtureDensity, StopRules
from sbi_active.campaign.learning.methods import METHODS
from sbi_active.campaign.learning.planner import most_unlike
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference import LFIRE
from tests.campaign import problem
from tests.campaign.problem import MODEL
from tests.effects import BIAS, drift

PRIOR = BoxUniform(-2 * torch.ones(1), 2 * torch.ones(1))
ACTIONS = DiscreteActions([-2.0, -1.0, 1.0, 2.0])
OPTIONS = evolve(problem.OPTIONS, details=CampaignDetails(num_scored=400))
SHIFT, LIBRARY = 0.8, [BIAS, drift()]


def campaign(effects=(BIAS,), method="asbi", *, constraint=None, **changes):
    options = evolve(OPTIONS, **changes)
    given = {"effects": effects, "constraint": constraint, "options": options}
    return Campaign(MODEL, PRIOR, ACTIONS, method=method, **given)


def tell(c, shift=SHIFT, actions=(1.0, -2.0, 2.0, -1.0, 2.0), per_trial=0.0):
    gen = torch.Generator().manual_seed(3)
    for i, action in enumerate(actions):
        x = 0.5 * action + shift + per_trial * i + 0.1 * torch.randn(1, generator=gen)
        c.tell(x, action=[action])


@pytest.fixture(scope="module")
def adopted():
    c = campaign((), "nsbi")
    tell(c)
    c.update()
    before, health = c.belief, c.health
    report = c.criticize(LIBRARY, evaluate=False)
    c.adopt(report)
    return c, before, health, report


def test_a_hidden_bias_alarms_and_is_adopted(adopted):
    c, before, health, report = adopted
    assert health == "alarm"
    assert report.verdict == "bias"
    # The bare simulator explains the trials at no slope: its belief is as wide as they
    # scatter, and says so.
    assert not before.diagnostics.trustworthy
    assert before.diagnostics.noise_inflation > 3
    assert float(before.log_prob(torch.tensor([0.5]))) > -2
    assert c.simulator is report.simulator
    assert c.prior is report.prior
    # Five measurements of noise .1: below .1 each.
    truth = torch.tensor([0.5, SHIFT])
    assert bool(((c.belief.mean - truth).abs() < 4 * 0.1).all())
    assert float(c.belief.log_prob(truth)) > 0
    assert c.health == "ok"


def test_a_campaign_goes_on_after_an_adoption(adopted):
    c, *_ = adopted
    trial = c.ask()
    c.tell(0.5 * trial.action + SHIFT)
    c.update()
    told = c.history[-1]
    assert told.version == 1
    assert told.surprise > 1e-2
    again = c.criticize(LIBRARY, evaluate=False)
    assert again.verdict == "none"
    with pytest.raises(ValueError, match="expected a report whose verdict names eff"):
        c.adopt(again)


def test_a_report_of_another_model_is_refused(adopted):
    c, _, _, report = adopted
    with pytest.raises(ValueError, match="expected a report of the current model, ver"):
        c.adopt(report)
    assert len(c.state.versions) == 2


def test_every_second_trial_may_go_where_none_was():
    c = Campaign(MODEL, PRIOR, ACTIONS, options=evolve(OPTIONS, check_every=2))
    actions = []
    for _ in range(4):
        actions.append(float(c.ask().action))
        c.tell([0.5 * actions[-1]])
    for index, (action, trial) in enumerate(zip(actions, c.history, strict=True)):
        executed = [torch.tensor([a]) for a in actions[:index]]
        unlike = most_unlike(ACTIONS, executed)
        is_check = index % 2 == 1
        assert trial.design.expected_information_gain.isnan().all() == is_check
        if is_check:
            assert action in unlike.values[:, 0].tolist()


# What a campaign may do


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
def test_a_constraint_is_kept_by_designed_and_random_actions(method):
    given = {"constraint": lambda action: action[:, 0] <= 1.5}
    actions = DiscreteActions([0.1, 1.0, 2.0, 3.0])
    c = problem.campaign(method, actions=actions, given=given)
    c.run(lambda action: 0.7 * action, num_rounds=3)
    assert all(float(t.action) <= 1.5 for t in c.history)
    if method == "asbi":
        assert float(c.history[0].action) == 1.0


@pytest.mark.parametrize(
    ("constraint", "side"), [(None, -1), (lambda action: action[:, 0] >= 0.5, 1)]
)
def test_a_constraint_is_kept_by_actions_about_the_model(constraint, side):
    c = campaign(constraint=constraint)
    for _ in range(2):
        c.tell([1.0], action=[2.0])
    trial = c.ask(target="model")
    assert side * float(trial.action) > 0


# What a campaign's next trial is for, and when it stops


def test_with_effects_a_trial_is_for_what_it_tells_more_about():
    c = campaign()
    c.tell([1.0], action=[2.0])
    c.tell([1.0], action=[2.0])
    # A slope and a bias explain two like trials; more of the same halves neither.
    trial = c.ask()
    assert trial.target == "model"
    assert float(trial.action) < 0  # the far side of the slope
    assert trial.design.estimator == "ModelIndexGain"
    assert "bias" in trial.design.notes[0]
    assert trial.num_simulations >= trial.design.num_simulations > 0
    assert "criticism" in trial.seconds


def test_where_nothing_is_open_the_trial_is_for_the_parameters():
    c = campaign()
    # Twelve clean trials on both sides: no bias that would matter.
    tell(c, shift=0.0, actions=(2.0, -2.0) * 6)
    assert c.health == "ok"
    assert c.ask().target == "theta"


def run(c, slope=0.5, shift=0.0, num_rounds=6):
    gen = torch.Generator().manual_seed(1)

    def real_system(action):
        return slope * action + shift + 0.1 * torch.randn(1, generator=gen)

    c.run(real_system, num_rounds=num_rounds)
    return c


def test_a_run_stops_once_little_is_left_to_learn():
    c = run(campaign(effects=(), stop=StopRules(min_information_gain=0.5)))
    assert 1 <= len(c.history) < 6
    assert c.pending is not None
    assert c.stop_reason.startswith("the next trial is expected to tell")
    assert "less than 0.5" in c.stop_reason


def test_a_run_stops_once_the_parameters_are_known():
    # One trial at the largest action leaves a deviation of .1 / 2.
    c = run(campaign(effects=(), stop=StopRules(max_sd=0.08)))
    assert len(c.history) == 1
    assert c.pending is None
    assert c.stop_reason.startswith("the parameters' standard deviations are 0.0")


def test_an_alarm_switches_the_stop_rules_off():
    stop = StopRules(max_sd=0.5, min_information_gain=0.5)
    c = campaign(effects=(), method="nsbi", stop=stop)
    tell(c, shift=0.8, actions=(2.0, -2.0))
    c.update()
    assert c.health == "alarm"
    assert float(c.belief.stddev) < 0.5  # as wide as trials scatter, and within
    assert c.stop_reason is None
    num_told = len(c.history)
    run(c, shift=0.8, num_rounds=2)
    assert len(c.history) == num_told + 2


# Every method of a campaign, through the same protocol


DENSITY = MixtureDensity(hidden_features=(16,), num_components=2, num_iterations=150)
TRAINED = dict.fromkeys(("asbi", "nsbi", "alhi", "nlhi"), DENSITY)
TRAINED["seqbed"] = problem.RATIOS
FEW = evolve(problem.RATIOS, num_iterations=5)
QUICK = {**dict.fromkeys(TRAINED, problem.OPTIONS.density_estimator), "seqbed": FEW}
GAINS = {"asbi": "posterior", "alhi": "likelihood", "seqbed": "ratio"}


def measured(action):
    return 0.7 * action


def small(method, **changes):
    sizes = {"num_simulations": 600, "density_estimator": TRAINED[method]}
    return problem.campaign(method, problem.noisy, **{**sizes, **changes})


@pytest.mark.parametrize("method", METHODS)
def test_a_round_its_cost_and_a_copy_that_goes_on(method):
    sizes = {"num_simulations": 300, "density_estimator": QUICK[method]}
    c = small(method, **sizes)
    trial = c.ask()
    assert METHODS[method].designs == (trial.target == "theta")
    assert trial.design.bound in ("lower", "none")
    c.tell(measured(trial.action))
    belief = c.update()
    assert float((belief.sample((2_000,)) - 0.7).abs().median()) < 0.3
    spent = c.history[0].num_simulations - 200 - trial.design.num_simulations
    trained = 300 if "training" in c.history[0].cpu_seconds else 0
    assert spent - trained == belief.diagnostics.num_simulations
    if method in ("asbi", "nsbi"):  # stops by itself
        assert 0 < spent - trained <= 17 * problem.REFINEMENT.num_histories
    else:
        with pytest.raises(ValueError, match="whose network is a posterior; got"):
            c.posterior  # noqa: B018
    if not METHODS[method].designs:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sbi's, of what its trainers lose
        copy = cloudpickle.loads(cloudpickle.dumps(c))
    assert copy.ask().action.equal(c.ask().action)
    for one in (c, copy):
        one.tell(torch.tensor([0.68]), action=[1.0])
        one.update()
    theta = torch.linspace(0.05, 0.95, 7)[:, None]
    expected = c.belief.log_prob(theta).tolist()
    assert copy.belief.log_prob(theta).tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("method", GAINS)
def test_each_method_has_its_authors_utility(method):
    c = small(method, estimator=GAINS[method], refine=False, num_samples=200)
    trial = c.ask()
    assert trial.action.tolist() == [3.0]
    assert trial.design.bound == ("lower" if method == "asbi" else "none")
    # log(3 / .1) less the noise's entropy: 1.98; a network on 600 rows is blunt.
    gain = float(trial.design.expected_information_gain[2])
    assert 1.0 < gain < 2.6
    c.tell(measured(trial.action))
    belief = c.update()
    assert belief.diagnostics.num_simulations == 0
    assert abs(float(belief.mean) - 0.7) < 0.1


def test_faithful_seqbed_is_lfire():
    sizes = {"num_simulations": 300, "refine": False, "estimator": "ratio"}
    c = small("seqbed", density_estimator=LFIRE(), **sizes)
    c.run(measured, num_rounds=1)
    assert c.belief.label == "weighted particles"
    assert c.history[0].design.estimator == "RatioGain"
    assert c.history[0].action.tolist() == [3.0]
    assert abs(float(c.belief.mean) - 0.7) < 0.15
