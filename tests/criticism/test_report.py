"""The report from its parts: what is printed when, and what the page contains."""

import pickle
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect, joint_prior
from sbi_active.criticism.cautions import find_warnings
from sbi_active.criticism.headline import with_error
from sbi_active.criticism.psis_loo import LeaveOneOut
from sbi_active.criticism.report import build_report
from sbi_active.criticism.results import (
    Detection,
    Estimate,
    Evaluation,
    Evidence,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.criticism.trials import Trials

DRAG = Effect(
    "drag",
    hook="observation",
    prior=Normal(0.0, 1.0),
    null=0.0,
    apply=lambda x, phi, action, context: x - phi,
)
NAMES = ["drag", "tilt", "bias"]
SHUFFLED = [2.0, -1.0, 3.0, 1.0, -2.0, -3.0, 1.5, -1.5, 2.5]


def evidence(name: str, log_evidence: float) -> Evidence:
    rng = np.random.default_rng(0)
    names = ("mu_1", "mu_2") if name == "none" else ("mu_1", "mu_2", name)
    return Evidence(
        name=name,
        log_evidence=log_evidence,
        standard_error=0.05,
        effective_sample_size=312.0,
        engine="least squares",
        num_simulations=7_000,
        names=names,
        draws=0.3 + 0.01 * rng.normal(size=(400, len(names))),
        best_chi_square=40.0,
    )


def estimate(name: str, probability: float, **changes) -> Estimate:
    made = Estimate(
        name=name,
        family="dynamics",
        units="1/m",
        describe="a force against the speed" if name == "drag" else "",
        probability=probability,
        log_bayes_factor=9.4,
        mean=np.array([0.123]),
        sd=np.array([0.011]),
        effective_sample_size=312.0,
        engine="least squares",
    )
    return replace(made, **changes)


def tracing(verdict: str = "drag", **changes) -> Tracing:
    probabilities = {"none": 0.004, "unexplained": 0.01, "scatter": 0.001}
    probabilities |= {"drag": 0.81, "tilt": 0.125, "bias": 0.05}
    chosen = (verdict,) if verdict in NAMES else ()
    made = Tracing(
        verdict=verdict,
        chosen=chosen,
        probabilities=probabilities,
        inclusion={"drag": 0.81, "tilt": 0.125, "bias": 0.05},
        credible_set=("drag", "tilt"),
        equivalent=(),
        near=(),
        aliases=(),
        estimates=tuple(estimate(n, probabilities[n]) for n in NAMES),
        evidences={n: evidence(n, -3.0) for n in ["none", *NAMES, "unexplained"]},
        robust=True,
    )
    return replace(made, **changes)


def residuals(shape=(6,), *, size: float = 1.0, num: int = 8, times=None) -> Residuals:
    rng = np.random.default_rng(1)
    z = size * rng.normal(size=(num, *shape))
    return Residuals(
        action=np.array(SHUFFLED[:num])[:, None],
        index=np.arange(num, dtype=float),
        times=times,
        x=z + 2,
        mean=np.full_like(z, 2.0),
        sd=np.ones_like(z),
        refitted=z,
        prequential=1.5 * z,
        correlation=0.8 if times is not None else 0.0,
        noise="declared",
    )


def evaluation(num: int = 8) -> Evaluation:
    rng = np.random.default_rng(2)
    before = {
        "rmse": 0.05 + 0.02 * rng.random(num),
        "energy score": 0.03 + 0.01 * rng.random(num),
        "log predictive density": -20 - 5 * rng.random(num),
        "coverage": np.round(rng.random(num) * 6) / 6,
    }
    after = {
        "rmse": before["rmse"] / 5,
        "energy score": before["energy score"] / 4,
        "log predictive density": before["log predictive density"] + 35,
        "coverage": np.full(num, 5 / 6),
    }
    enough = num >= 8
    rows = []
    for name in before:
        b, a = before[name].mean(), after[name].mean()
        ratio = a - b if name in ("log predictive density", "coverage") else a / b
        ends = (0.9 * ratio, 1.1 * ratio) if enough else (np.nan, np.nan)
        rows.append((name, b, a, ratio, *ends))
    columns = pd.Index(["metric", "before", "after", "ratio", "low", "high"])
    return Evaluation(
        scheme="held out",
        trials=np.arange(num, dtype=float),
        before=before,
        after=after,
        table=pd.DataFrame(rows, columns=columns),
    )


def left_out(name: str, *, density: float, k: float = 0.2) -> LeaveOneOut:
    pareto_k = np.full(8, 0.2)
    pareto_k[[3, 5]] = k
    each = density + 0.1 * np.arange(8)
    return LeaveOneOut(name=name, density=each, pareto_k=pareto_k, num_draws=400)


def flat(made) -> str:
    """Return the text of a report as one line."""
    return " ".join(str(made).split())


def trials(action=SHUFFLED[:8]) -> Trials:
    return Trials(torch.tensor(action), torch.randn(len(action), 6))


def report(**changes):
    noise = GaussianNoise(0.005)
    parts = {
        "trials": trials(),
        "residuals": residuals(size=6.0),
        "residuals_after": residuals(),
        "detection": Detection(
            log_bayes_factor=8.2,
            standard_error=0.1,
            lower=8.0,
            threshold=float(np.log(20)),
            chi_square=180.4,
            degrees_of_freedom=46,
            p_value=1e-16,
            level=0.01,
            null_log_evidence=-3.0,
            null_cross_check=-3.1,
        ),
        "tracing": tracing(),
        "evaluation": evaluation(),
        "next_action": NextAction(
            action=np.array([3.0]),
            candidates=np.array([[1.0], [3.0]]),
            information_gain=np.array([0.1, 0.41]),
            separates=("drag", "tilt"),
        ),
        "simulator": SimulatorModel(
            lambda theta, action: theta[:, :1] * torch.ones(1, 6), noise=noise
        ),
        "prior": BoxUniform(torch.zeros(3), torch.ones(3)),
        "actions": DiscreteActions([1.0, 3.0], names=["speed"], units=["m/s"]),
        "digest": "0123456789abcdef",
        "leave_one_out": (left_out("none", density=-20), left_out("drag", density=2)),
    }
    return build_report(**(parts | changes))


def test_the_verdict_is_in_the_first_line():
    first = str(report()).splitlines()[0]
    assert first == "Verdict: drag (P = 0.81)"


def test_the_verdict_line_says_what_limits_it():
    made = report(
        tracing=tracing(
            robust=False,
            equivalent=(frozenset({"drag", "bias"}),),
        )
    )
    assert str(made).splitlines()[0] == (
        "Verdict: drag (P = 0.81), not robust to its prior; no permitted action tells "
        "it from bias"
    )


def test_a_guess_is_called_a_guess():
    unsure = report(tracing=tracing("unexplained"))
    assert unsure.guess is None
    assert "guess, not declared" not in flat(unsure)
    sure = report(tracing=tracing("unexplained", guesses=(("c xi^2", 3.1),)))
    assert sure.guess == "c xi^2"
    assert "a guess, not declared: c xi^2" in flat(sure)


def test_scatter_is_no_cause():
    text = str(report(tracing=tracing("scatter"), residuals_after=None))
    assert text.startswith("Verdict: scatter")
    assert "which is no cause" in text


def test_before_after_has_its_columns_and_intervals():
    table = report().before_after
    assert [*table.columns] == ["metric", "before", "after", "ratio", "interval"]
    rmse = table.set_index("metric").loc["rmse"]
    assert rmse["ratio"] == pytest.approx(rmse["after"] / rmse["before"])
    assert rmse["interval"] == pytest.approx((0.9 * rmse["ratio"], 1.1 * rmse["ratio"]))


def test_few_scored_trials_have_no_interval_and_say_so():
    made = report(evaluation=evaluation(5))
    assert made.before_after["interval"].isna().all()
    assert "Below 8 trials" in flat(made)
    scores = made.evaluation
    for i in range(5):
        before, after = scores.before["rmse"][i], scores.after["rmse"][i]
        assert f"- held-out trial {i}: RMSE {before:.3g} -> {after:.3g}" in flat(made)
    assert "Below 8 trials" not in flat(report())


def test_parameters_stand_before_and_after():
    table = report().parameters.set_index("parameter")
    assert [*table.index] == ["mu_1", "mu_2", "drag"]
    assert np.isnan(table.loc["drag", "before"])
    assert table.loc["drag", "after"] == pytest.approx(0.3, abs=4 * 0.01 / 20)


def test_left_out_trials_say_how_often_the_verdict_was_the_same():
    folds = (*["drag"] * 7, "tilt")
    scores = replace(evaluation(), scheme="leave one out", selected=folds)
    text = flat(report(evaluation=scores))
    assert "8 trials, each predicted by models that were chosen and fitted" in text
    assert "7 of 8 such verdicts are drag" in text


def test_a_report_pickles_with_effects_that_are_local_functions():
    made = report(prior=joint_prior(BoxUniform(torch.zeros(2), torch.ones(2)), [DRAG]))
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        pickle.dumps(DRAG)
    again = pickle.loads(pickle.dumps(made))
    assert str(again) == str(made)
    assert again.prior.sample((4,)).shape == (4, 3)
    theta, action = torch.ones(2, 2), torch.ones(2, 1)
    assert (again.simulator.mean(theta, action) == 1).all()


def test_the_first_sentences_have_the_error_with_its_interval():
    rmse = report().before_after.set_index("metric").loc["rmse"]
    before, after, ratio = (f"{rmse[n]:.3g}" for n in ("before", "after", "ratio"))
    low, high = (f"{end:.3g}" for end in rmse["interval"])
    sentence = f"goes from {before} to {after} (ratio {ratio}, 90 % interval {low} to "
    assert f"{sentence}{high})." in flat(report())
    assert f"goes from {before} to {after}." in flat(
        report(
            evaluation=replace(
                evaluation(), table=evaluation().table.assign(low=np.nan, high=np.nan)
            )
        )
    )


def test_numbers_have_the_digits_that_their_deviation_leaves():
    assert with_error(0.35992, 0.00071) == "0.35992 +- 0.00071"
    assert with_error(-1234.56, 56.7) == "-1235 +- 57"
    assert with_error(0.3, 0.0996) == "0.30 +- 0.10"
    assert with_error(3.2e-7, 1e-8) == "3.2e-07 +- 1e-08"
    assert with_error(2.0, 0.0) == "2 +- 0"
    assert with_error(np.nan, np.nan) == ""


def test_tables_stand_in_columns():
    lines = str(report()).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("model  "))
    rows = lines[start : start + 7]
    assert " ".join(rows[0].split()) == "model P phi log BF ESS 90 % set"
    assert rows[1].startswith("drag  ")
    assert "0.123 +- 0.011 1/m" in rows[1]
    ends = {row.index("312") + 3 for row in rows if "312" in row}
    assert ends == {rows[0].index("ESS") + 3}
    assert max(map(len, lines)) <= 88


def test_leaving_one_out_stands_beside_the_evidence():
    text = flat(report())
    assert "bare model -157.2 0.20 none with drag 18.8 0.20 none" in text
    assert "a trial decides so much" not in text
    assert "k > 0.62" in text  # 1 - 1 / log10 of 400 draws
    unsure = left_out("drag", density=2, k=0.9)
    text = flat(report(leave_one_out=(left_out("none", density=-20), unsure)))
    assert "with drag 18.8 0.90 3, 5" in text
    assert "a trial decides so much" in text


def test_the_residual_process_is_not_left_one_out():
    only = (left_out("none", density=-20),)
    text = flat(report(tracing=tracing("unexplained"), leave_one_out=only))
    assert "The residual process joins the trials" in text
    assert "Leave one out" not in flat(report(leave_one_out=()))


def stopped(**changes):
    """Return a report in which no permitted action is worth a trial."""
    return report(next_action=replace(report().next_action, action=None, **changes))


GROUP = frozenset({"tilt", "none"})
BEYOND = {
    "outside": np.array([-3.0]),
    "outside_separates": ("none", "tilt"),
    "outside_gain": 0.6,
}


@pytest.mark.parametrize("setting", ["text", "markdown", "page"])
def test_what_no_permitted_action_separates_is_printed_everywhere(setting):
    def words(made):
        page = {"text": str, "markdown": type(made).to_markdown}
        return " ".join(page.get(setting, type(made).to_html)(made).split())

    made = words(stopped(inseparable=(GROUP, frozenset({"drag", "bias"})), **BEYOND))
    assert (
        "no permitted action separates none and tilt; speed = -3 m/s, which is not "
        "permitted, would: at least 0.60 nats"
    ) in made
    alone = "no permitted action separates bias and drag"
    assert alone in made
    assert f"{alone};" not in made
    assert "no permitted action separates" not in words(report())


def test_an_action_that_is_chosen_can_leave_a_group_unseparated():
    chosen = replace(report().next_action, inseparable=(GROUP,))
    text = flat(report(next_action=chosen))
    assert "speed = 3 m/s: at least 0.41 nats between drag, tilt" in text
    assert "- no permitted action separates none and tilt" in text


def test_nothing_more_to_do_is_a_stop():
    worth = "Stop: no permitted action tells more about which model is right than 0.410"
    assert worth in flat(stopped())
    assert "Stop: no model but drag is left." in flat(stopped(separates=("drag",)))
    assert "speed = 3 m/s: at least 0.41 nats between drag, tilt" in flat(report())


def test_a_report_of_a_right_model_has_no_warnings():
    arguments = {"trials": trials(), "residuals": residuals(), "tracing": tracing()}
    assert find_warnings(**arguments) == ()
    assert "Warnings" not in str(report())


class Page(HTMLParser):
    """Collects what a page refers to and whether its elements are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.images += [values["src"]] if tag == "img" else []
        assert "href" not in values
        assert tag != "script"
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_self_contained():
    page = Page()
    page.feed(report().to_html())
    assert page.open == []
    assert len(page.images) == 3
    assert all(source.startswith("data:image/png;base64,") for source in page.images)


def test_names_are_escaped_on_the_page():
    formula = "c |xi|^1.5 <x>"
    made = report(tracing=tracing("unexplained", guesses=((formula, 4.0),)))
    page = made.to_html()
    assert "&lt;x&gt;" in page
    assert formula not in page


def test_markdown_tables_have_as_many_cells_as_headings():
    shares = {"a|b": 0.6, "drag": 0.4}
    made = report(tracing=tracing(probabilities=shares, credible_set=(*shares,)))
    text = re.sub(r"\\\|", "", made.to_markdown())
    blocks = re.findall(r"(?:^\|.*\|$\n?)+", text, flags=re.MULTILINE)
    assert len(blocks) == 5
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_save_writes_the_page_and_every_figure(tmp_path):
    made = report()
    page = made.save(tmp_path / "out")
    names = {path.name for path in page.parent.iterdir()}
    pictures = {"residuals.png", "probabilities.png", "before_after.png"}
    assert names == {"report.txt", "report.md", "report.html"} | pictures
    linked = re.findall(r"\]\((.+?)\)", (page.parent / "report.md").read_text())
    assert {*linked} == pictures


@pytest.mark.parametrize("shape", [(1,), (6,), (50,), (20, 2)])
def test_residual_panels_by_kind_of_observation(shape):
    times = np.linspace(0, 2, shape[0]) if shape[0] > 6 else None
    made = report(
        residuals=residuals(shape, size=40.0, times=times),
        residuals_after=residuals(shape, times=times),
    )
    from sbi_active.criticism.figures import plot_residuals

    figure = plot_residuals(made.residuals, made.residuals_after)
    labels = [ax.get_xlabel() for ax in figure.axes]
    last = {(1,): [], (6,): ["channel"]}.get(shape, ["time [s]"])
    assert labels == 2 * ["action 1", "trial", *last]
    largest = np.abs(made.residuals.refitted).max()
    assert figure.axes[0].get_ylim()[1] > largest
