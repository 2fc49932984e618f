"""Attacks on the closed loop: outliers, aliases, effects and noise declared wrong."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.small_loop import (
    ACTIONS,
    CUBIC,
    LIBRARY,
    MODEL,
    NOISE,
    PRIOR,
    XI,
    line,
    loop,
    measured,
    normal,
    refused,
    theta_is_right,
    usual,
)
from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Effect, Report, Trials
from sbi_active.criticism.data import Role
from sbi_active.criticism.report.summary import suspects

ATTACKS = Attacks()

SLIPS = (10.0, -20.0, 1e3, -1e6, 1e15, -1e30, 1e200, "x100", "x1e6", "-x")


@ATTACKS.add("one trial has a gross error [sd]", cases=SLIPS)
def one_gross_error(case: float | str) -> None:
    x = measured()
    if isinstance(case, str):
        x[1] = {"x100": 100, "x1e6": 1e6, "-x": -1}[case] * x[1]
    else:
        x[1] += case * NOISE
    report = loop(x)
    assert suspects(report.tracing) == (1.0,)
    if case == SLIPS[0]:  # about as well all trials scatter
        assert report.verdict in ("outlier", "scatter"), report.verdict
        assert "outlier: trial 1" in str(report).partition("Warnings")[0]
        return
    assert report.verdict == "outlier", report.verdict
    assert "trial 1" in str(report).splitlines()[0]
    assert report.simulator is MODEL
    theta_is_right(report)


@ATTACKS.add("each trial in turn is off by 20 sd", cases=range(8))
def any_trial(case: int) -> None:
    x = measured(seed=1)
    x[case] += 20 * NOISE
    report = loop(x)
    assert report.verdict not in ("cubic", "bend", "cubic + bend"), report.verdict
    assert float(case) in suspects(report.tracing)


@ATTACKS.add("outliers under other indices", cases=("from 11", "reversed", "gaps"))
def other_indices(case: str) -> None:
    index = torch.arange(8) + 11
    index = {"from 11": index, "reversed": index.flip(0), "gaps": 3 * index}[case]
    x = measured()
    x[4] -= 25 * NOISE
    report = loop(x, index=index)
    assert suspects(report.tracing) == (float(index[4]),)
    assert f"trial {int(index[4])}" in str(report).splitlines()[0]


@ATTACKS.add("several gross errors", cases=(2, 3))
def several_gross_errors(case: int) -> None:
    x = measured()
    x[[1, 6, 3][:case], 0] += torch.tensor([30.0, -17.0, 55.0])[:case].double() * NOISE
    report = loop(x)
    assert report.verdict in ("outlier", "scatter", "unexplained"), report.verdict


@ATTACKS.add("all trials in another unit", cases=(100.0, 1e6, 1e15))
def all_in_another_unit(case: float) -> None:
    assert loop(case * measured()).verdict != "none"


@ATTACKS.add("a held-out trial is off", cases=(20.0, 1e15))
def held_out_is_off(case: float) -> None:
    x = torch.cat([measured(), measured(seed=2)])
    x[-1] += case * NOISE
    role = ["fit"] * 8 + ["held out"] * 8
    report = loop(x, torch.cat([XI, XI]), role=role, evaluate=True)
    assert report.verdict == "none"
    rmse = report.before_after.set_index("metric").loc["rmse", "before"]
    assert abs(rmse / (case * NOISE / 8**0.5) - 1) < 0.1, rmse


@ATTACKS.add("nothing is wrong, by seed", cases=range(5))
def nothing_is_wrong(case: int) -> None:
    report = loop(measured(seed=case + 10), seed=case)
    assert report.verdict == "none", report.verdict
    assert not report.tracing.outliers
    theta_is_right(report)


@ATTACKS.add("a hidden cubic term", cases=(-1.5, -0.4, 0.4, 1.5))
def hidden_cubic(case: float) -> None:
    report = loop(measured(cubic=case))
    assert report.verdict == "cubic", report.verdict
    estimate = next(e for e in report.tracing.estimates if e.name == "cubic")
    assert abs(estimate.mean[0] - case) < 4 * estimate.sd[0]
    theta_is_right(report)


@ATTACKS.add("a hidden term and an outlier beside", cases=(1, 5))
def hidden_term_and_outlier(case: int) -> None:
    x = measured(cubic=1.0)
    x[case] += 30 * NOISE
    report = loop(x)
    if report.tracing.chosen:  # then the cubic term and no stand-in
        assert "cubic" in report.tracing.chosen, report.verdict


@ATTACKS.add("noise declared too large", cases=(30.0, 100.0, 1e4))
def noise_too_large(case: float) -> None:
    model = SimulatorModel(line, noise=GaussianNoise(case * NOISE))
    report = loop(measured(), model=model)
    (said,) = [w for w in report.warnings if "far smaller than the declared" in w]
    assert "declare the error of the measurement" in said
    assert report.detection.least_chi_square < 8 * (4 / case) ** 2


@ATTACKS.add("t noise declared 100 times too large")
def student_noise_too_large(case: str) -> None:
    model = SimulatorModel(line, noise=StudentTNoise(100 * NOISE, 4.0))
    said = " ".join(loop(measured(), model=model).warnings)
    assert "far smaller than the declared noise allows" in said


@ATTACKS.add("noise declared right or twice too large", cases=(1.0, 2.0))
def noise_about_right(case: float) -> None:
    model = SimulatorModel(line, noise=GaussianNoise(case * NOISE))
    report = loop(measured(), model=model)
    assert report.verdict == "none"
    assert not any("far smaller" in warning for warning in report.warnings)


@ATTACKS.add("noise declared too small", cases=(3.0, 10.0, 100.0))
def noise_too_small(case: float) -> None:
    model = SimulatorModel(line, noise=GaussianNoise(NOISE / case))
    report = loop(measured(), model=model)
    assert report.verdict in ("scatter", "unexplained"), report.verdict


@ATTACKS.add("no noise", cases=("undeclared", "zero"))
def no_noise(case: str) -> None:
    def build() -> Report:
        noise = GaussianNoise(0.0) if case == "zero" else None
        return loop(measured(), model=SimulatorModel(line, noise=noise))

    refused("noise" if case == "undeclared" else "> 0", build)


KINDS = ("float32", "numpy", "list", "flat", "strided", "column of a table")


@ATTACKS.add("the same numbers in another form", cases=KINDS)
def other_forms(case: str) -> None:
    x = measured().float()  # that all forms can hold
    expected = loop(x.double())
    wide = torch.zeros(8, 3).double()
    wide[:, 1:2] = x
    form = {
        "float32": x,
        "numpy": x.numpy(),
        "list": list(x.double()),
        "flat": x[:, 0],
        "strided": torch.stack([x, x], 1).reshape(16, 1)[::2],
        "column of a table": wide[:, 1],
    }[case]
    found = loop(form)
    assert found.probabilities == expected.probabilities


@ATTACKS.add("trials in another order", cases=(1, 2, 3))
def another_order(case: int) -> None:
    x = measured(cubic=0.8)
    order = torch.randperm(8, generator=torch.Generator().manual_seed(case))
    report = loop(x[order], XI[order], index=order)
    assert report.verdict == "cubic"
    usual_p = loop(x).detection.chi_square
    assert abs(report.detection.chi_square - usual_p) < 1.0


@ATTACKS.add("another seed", cases=(1, 2, 2**40))
def another_seed(case: int) -> None:
    report = loop(measured(), seed=case)
    again = loop(measured(), seed=case)
    assert report.probabilities == again.probabilities
    assert abs(report.probabilities["none"] - usual().probabilities["none"]) < 0.05


@ATTACKS.add("another unit of x", cases=(1e-6, 1e6))
def another_unit(case: float) -> None:
    def scaled(theta: Tensor, action: Tensor, cubic: Any = 0.0) -> Tensor:
        return case * line(theta, action, cubic)

    model = SimulatorModel(scaled, noise=GaussianNoise(case * NOISE))
    report = loop(case * measured(cubic=0.8), model=model, effects=[CUBIC])
    expected = loop(measured(cubic=0.8), effects=[CUBIC])
    assert report.verdict == expected.verdict == "cubic"
    apart = report.detection.log_bayes_factor - expected.detection.log_bayes_factor
    assert abs(apart) < 0.5


@ATTACKS.add("what was not measured", cases=("a trial", "inf", "half of a trial"))
def not_measured(case: str) -> None:
    x = measured(cubic=0.8)
    if case == "half of a trial":
        model = SimulatorModel(
            lambda theta, action, cubic=0.0: line(theta, action, cubic).expand(-1, 2),
            noise=GaussianNoise(NOISE),
        )
        two = torch.cat([x, measured(seed=1, cubic=0.8)], 1)
        two[3, 1] = torch.nan
        report = loop(two, model=model, effects=[CUBIC])
    else:
        x[3] = torch.nan if case == "a trial" else torch.inf
        report = loop(x, effects=[CUBIC])
    assert report.verdict == "cubic", report.verdict
    theta_is_right(report)


@ATTACKS.add(
    "an effect named like a catch-all",
    cases=("none", "unexplained", "scatter", "outlier"),
)
def reserved_names(case: str) -> None:
    effect = Effect(
        case,
        hook="observation",
        prior=normal(1.0),
        null=0.0,
        apply=lambda x, phi, action, context: x + phi,
    )
    refused("expected effects not named", lambda: loop(measured(), effects=[effect]))


@ATTACKS.add("an effect that does not vanish at its null", cases=(1.0, -3.0))
def does_not_vanish(case: float) -> None:
    effect = Effect(
        "wrong",
        hook="observation",
        prior=normal(1.0),
        null=case,
        apply=lambda x, phi, action, context: x + phi,
    )
    refused("to vanish at its null", lambda: loop(measured(), effects=[effect]))


ROLES: list[Role] = ["fit"] * 8
WRONG = {
    "fewer rows of x": ("as many rows", lambda: Trials(XI, measured()[:5])),
    "NaN action": ("finite actions", lambda: Trials(XI / 0 * 0, measured())),
    "no measurement": (
        "at least one valid",
        lambda: Trials(XI, measured() * torch.nan),
    ),
    "an index too few": ("index", lambda: Trials(XI, measured(), index=range(7))),
    "a role too few": ("role", lambda: Trials(XI, measured(), role=ROLES[:7])),
    "one trial": ("two valid trials", lambda: loop(measured()[:1], XI[:1])),
    "another dimension of the action": (
        "dimension 1",
        lambda: loop(measured(), actions=DiscreteActions([[1.0, 2.0]])),
    ),
    "x of another shape": ("shape", lambda: loop(measured().expand(-1, 3))),
}


@ATTACKS.add("trials that do not fit", cases=(*WRONG,))
def trials_that_do_not_fit(case: str) -> None:
    refused(*WRONG[case])


@ATTACKS.add("few or equal trials", cases=("two", "three", "one action"))
def few_trials(case: str) -> None:
    if case == "one action":
        xi = torch.ones(8)
        report = loop(measured(xi=xi), xi)
    else:
        num = {"two": 2, "three": 3}[case]
        report = loop(measured()[:num], XI[:num])
    assert report.verdict == "none", report.verdict
    assert abs(sum(report.probabilities.values()) - 1) < 1e-9


@ATTACKS.add("what the caller holds", cases=("generators", "tensors"))
def what_the_caller_holds(case: str) -> None:
    x, xi = measured(), XI.clone()
    torch.manual_seed(5)
    np.random.seed(5)
    state = torch.get_rng_state()
    loop(x, xi, seed=3)
    if case == "generators":
        assert torch.equal(state, torch.get_rng_state())
        assert np.random.rand() == np.random.RandomState(5).rand()
    else:
        assert torch.equal(x, measured())
        assert torch.equal(xi, XI)


@ATTACKS.add("a report of an outlier travels", cases=("pickle", "html", "markdown"))
def report_travels(case: str) -> None:
    x = measured()
    x[1] += 20 * NOISE
    report = loop(x)
    if case == "pickle":
        twin = pickle.loads(pickle.dumps(report))
        assert twin.tracing.outliers == report.tracing.outliers
        assert str(twin) == str(report)
    else:
        page = report.to_html() if case == "html" else report.to_markdown()
        assert "outlier: trial 1" in page


@ATTACKS.add("the next action after an outlier")
def next_action_after_an_outlier(case: str) -> None:
    x = measured()
    x[7] += 20 * NOISE
    criticism = Criticism(MODEL, PRIOR, Trials(XI, x), effects=LIBRARY, actions=ACTIONS)
    found = criticism.next_action()
    assert np.isfinite(found.information_gain).all()


# What a report says of aliases and of effects that were declared wrong.
