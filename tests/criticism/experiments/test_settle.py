"""Trials that decide, on models whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sbi_active import DiscreteActions
from sbi_active.criticism import Criticism, Trials, close_loop
from sbi_active.criticism.experiments import choice
from sbi_active.criticism.experiments.settle import NAME, VerdictError, settle
from sbi_active.criticism.misfit.rule import Rule
from tests.criticism.misfit import oscillator
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.effects import added

pytestmark = pytest.mark.usefixtures("few_draws")

#: Trials so far were all forward; the robot may go back as well.
FORWARD = torch.tensor([1.0, 1.5, 2.0, 2.5, 3.0, 1.0, 2.0, 3.0])[:, None]
BOTH = DiscreteActions([-3.0, -1.0, 1.0, 3.0])


#: Forward they are the same to the last bit, backward they have opposite signs.
FORMS = {"lift": lambda xi: xi**2, "drag": lambda xi: xi * xi.abs()}
LIBRARY = [EVEN, ODD] = [added(name, form) for name, form in FORMS.items()]


class Robot:
    """A robot with one effect, that counts its trials."""

    def __init__(self, form=None, size=0.5, seed=0):
        self.form, self.size, self.asked = form, size, []
        self.gen = torch.Generator().manual_seed(seed)

    def __call__(self, action):
        self.asked.append(float(action))
        return self.read(action[None])[0]

    def read(self, action):
        x = read(0.7 * action, self.gen)
        return x if self.form is None else x + self.size * self.form(action)

    def trials(self):
        return Trials(FORWARD, self.read(FORWARD))


def loop(robot, trials, **options):
    options = {"effects": LIBRARY, "actions": BOTH, "evaluate": False, **options}
    return close_loop(MODEL, PRIOR, trials, real_system=robot, **options)


@pytest.mark.parametrize(("name", "seed"), [("lift", 1), ("drag", 2)])
def test_a_chosen_trial_tells_a_cause_from_its_exact_alias(name, seed):
    robot = Robot(FORMS[name], seed=seed)
    trials = robot.trials()
    passive = Criticism(MODEL, PRIOR, trials, effects=LIBRARY)
    assert passive.trace().probabilities[name] < 0.6
    report = loop(robot, trials)
    assert report.verdict == name
    assert report.probabilities[name] > 0.95
    assert report.stopped == "settled"
    assert len(robot.asked) <= 3
    assert min(robot.asked) < 0
    assert len(report.residuals.index) == len(FORWARD) + len(robot.asked)
    assert all(trial.after for trial in report.tested)


def test_the_alias_is_withdrawn_by_the_rule_that_named_it():
    """A library without the cause names its alias, until a trial backward."""
    robot = Robot(FORMS["drag"], seed=3)
    trials = robot.trials()
    passive = Criticism(MODEL, PRIOR, trials, effects=[EVEN])
    assert passive.trace().verdict == "lift"
    report = loop(robot, trials, effects=[EVEN])
    assert report.verdict != "lift"
    first = report.tested[0]
    assert (first.verdict, first.held) == ("lift", False)
    assert first.distance > 3 * first.limit
    assert "failed" in str(report)


def test_a_clean_simulator_loses_at_most_one_trial():
    robot = Robot()
    report = loop(robot, robot.trials())
    assert report.verdict == "none"
    assert len(robot.asked) <= 1


def test_a_registered_prediction_is_that_of_linear_least_squares():
    robot = Robot(FORMS["drag"], seed=4)
    trials = robot.trials()
    report = loop(robot, trials, effects=[ODD], max_trials=1)
    own = report.tested[0]
    design = torch.cat([FORWARD, FORMS["drag"](FORWARD)], 1).double()
    new = torch.tensor([float(own.action[0])]).double()
    new = torch.stack([new, FORMS["drag"](new)], 1)
    prior = torch.diag(torch.tensor([0.0, 1.0]))
    cov = torch.linalg.inv(design.T @ design / NOISE**2 + prior)
    mean = new @ cov @ design.T @ trials.x.double() / NOISE**2
    sd = float((NOISE**2 + new @ cov @ new.T).sqrt())
    assert own.verdict == "drag"
    assert own.mean[0] == pytest.approx(float(mean), abs=4 * sd / 400**0.5)
    assert own.sd[0] == pytest.approx(sd, rel=4 / 800**0.5)
    assert own.limit == pytest.approx(1.645, abs=0.3)  # 4 errors of a quantile of 400
    alone = FORWARD.double()
    bare = float(own.action[0]) * float((alone * trials.x).sum() / (alone**2).sum())
    assert own.without["drag"][0] == pytest.approx(bare, abs=0.02)


def test_an_effect_is_withdrawn_by_the_rule_that_named_it():
    """By what it leaves of the error of predictions, in place of that of fits."""
    action = torch.linspace(0.5, 2.0, 9, dtype=torch.float64)[:, None]
    every = oscillator.trials(action=action, lag=0.3, hidden=0.6)
    report = close_loop(
        *(oscillator.MODEL, oscillator.PRIOR, every[:8]),
        effects=oscillator.EFFECTS[2:3],
        actions=DiscreteActions(action[8:]),
        real_system=lambda action: every.x[8],
        max_trials=1,
        evaluate=False,
    )
    (trial,) = report.tested
    own, remaining = trial, Rule().remaining
    assert report.tracing.misfit.named == (*own.without,) == ("lag",)
    assert trial.held
    # As wide as errors on left-out trials, which t of few trials widens.
    left_out = report.tracing.misfit.of("lag").left_out[0]
    assert left_out < own.limit * own.sd.mean() < 3 * left_out

    def off(share):
        """Return a trial in which the effect leaves a share of the squared error."""
        without = {"lag": own.mean + own.sd * (1 + share**-0.5)}
        return replace(own, without=without, x=own.mean + own.sd)

    def after(*tested):
        return choice.unless_unproven(replace(report, tested=tested), remaining)

    assert off(0.2).held
    for tested in ([trial], [off(0.9 * remaining)], [off(0.2), off(0.3)]):
        assert after(*tested).verdict == "lag"
    for tested in ([off(1.1 * remaining)], [off(0.2), off(0.4)]):
        assert after(*tested).verdict == "unexplained"
    exact = replace(own, without={"lag": own.mean}, x=own.mean)
    assert after(exact).verdict == "unexplained"  # without it predicted as well
    found = after(replace(own, without={}))
    assert (found.verdict, found.tracing.beside) == ("unexplained", ("lag",))
    assert found.tracing.key == report.tracing.key  # it still predicts
    assert choice.probability_of(found) == 0.0
    assert found.warnings[-1].code == "SA533"
    assert "unexplained" in str(found).splitlines()[0]


@pytest.mark.parametrize(("most", "worth"), [(1, 1), (30, 1), (30, 30)])
def test_nine_of_ten_further_errors_stay_below_the_limit(most, worth):
    """Whatever the numbers of a trial are worth, and whatever their size."""
    rng = np.random.default_rng(0)
    draws = 7 * rng.chisquare(worth, (600, 8)) / worth
    below = [new <= choice.limit_of(before, most) ** 2 for *before, new in draws]
    # A prior of what a trial is worth has a share in it where few trials tell of that.
    assert 0.86 < np.mean(below) < 0.96


def comparing(fails_at=()):
    """Return a comparison whose report fails with so many trials."""

    def compare(trials):
        found = Criticism(MODEL, PRIOR, trials, effects=LIBRARY, actions=BOTH)
        if len(trials) in fails_at:
            found.report = diverge
        return found

    def diverge(**options):
        raise ArithmeticError("the solver diverged")

    return compare


def test_a_measurement_is_kept_though_the_verdict_fails(tmp_path):
    robot = Robot(FORMS["drag"], seed=5)
    trials, num = robot.trials(), len(FORWARD)
    options = {"max_trials": 3, "directory": tmp_path, "evaluate": False}
    with pytest.raises(VerdictError, match="the solver diverged") as raised:
        settle(comparing({num + 1}), trials, robot, **options)
    assert len(raised.value.trials) == num + 1
    kept = [json.loads(line) for line in (tmp_path / NAME).read_text().splitlines()]
    assert [event["event"] for event in kept] == ["begun", "registered", "measured"]
    assert kept[2]["x"] == pytest.approx(raised.value.trials.x[-1].tolist())
    with (tmp_path / NAME).open("a") as file:
        file.write('{"event": "judged", "ind')  # cut off by a crash
    report = settle(comparing(), trials, robot, **options)
    assert report.verdict == "drag"
    assert len(robot.asked) == len(report.tested) == 2  # none was run twice
    again = settle(comparing(), trials, robot, **options)
    assert len(robot.asked) == len(again.tested) == len(report.tested)
    with pytest.raises(ValueError, match="another directory"):
        settle(comparing(), trials[:-1], robot, **options)


def test_a_trial_comes_after_those_that_were_held_out():
    robot = Robot(FORMS["drag"], seed=7)
    fitted, more = robot.trials(), Robot(FORMS["drag"], seed=8).trials()
    x, action = torch.cat([fitted.x, more.x[:3]]), torch.cat([FORWARD, FORWARD[:3]])
    role = ["fit"] * len(FORWARD) + ["held out"] * 3
    report = loop(robot, Trials(action, x, role=role), evaluate=True)
    assert report.verdict == "drag"
    assert [t.index for t in report.tested][0] == len(action)
    assert report.evaluation.scheme == "held out"
    table = report.before_after.set_index("metric")
    assert table.loc["rmse", "ratio"] < 0.5


def test_a_trial_without_a_measurement_neither_holds_nor_fails():
    robot, lost = Robot(FORMS["lift"]), [torch.full((1,), torch.nan)]

    def lost_first(action):
        return lost.pop() if lost else robot(action)

    report = loop(lost_first, robot.trials(), max_trials=2)
    assert not report.tested[0].is_measured
    assert "SA531" not in [w.code for w in report.warnings]
