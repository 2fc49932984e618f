"""The report from its parts: summary, numbers, figures, and its other forms."""

import json
import pickle
import re

import numpy as np
import pytest
import torch
from matplotlib import image
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Trials, close_loop, generic_effects
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.report.gate import EXIT_CODES
from sbi_active.criticism.report.sections import head
from sbi_active.display.panels import AFTER, BEFORE, plot_residuals
from tests.criticism import block
from tests.criticism.report.reports import DRAG, report, residuals, tracing
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.display.browser import Parsed
from tests.effects import BIAS

TESTS = (SevereTest(action=np.array([3.0]), is_permitted=True, difference=1.234),)


def test_a_dictionary_has_no_probabilities_where_they_contradict_the_verdict():
    plain = report().to_dict()
    assert plain["probabilities"] == pytest.approx(report().probabilities)
    assert plain["misfit"] is None
    withdrawn = report(tracing=tracing("unexplained", instead_of="drag")).to_dict()
    assert withdrawn["probabilities"] is withdrawn["credible_set"] is None
    guessed = tracing("unexplained", guesses=(("xi^2", 9.0),))
    assert report(tracing=guessed).guess == "xi^2"


def test_a_report_goes_through_json_with_all_sections():
    made = report(severe_tests=TESTS)
    again = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert again["verdict"] == "drag"
    assert " ".join(again["summary"]) == " ".join(head(made)[1:])
    assert again["next_action"]["candidates"][-1] == [3.0]
    assert len(again["residuals_by_trial"]) == 8
    titles = [section["title"] for section in again["sections"]]
    assert titles == [t for t in str(made).splitlines() if t in titles]
    assert again["sections"][0]["table"]["header"][0] == "model"


def test_a_report_pickles_with_effects_that_are_local_functions():
    made = report()
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        pickle.dumps(DRAG)
    again = pickle.loads(pickle.dumps(made))
    assert str(again) == str(made)
    assert again.prior.sample((4,)).shape == (4, 3)
    theta, action = torch.ones(2, 3), torch.ones(2, 1)
    assert (again.simulator.mean(theta, action) == 3).all()


# The page, its tables and figures


def test_markdown_tables_have_as_many_cells_as_headings():
    shares = {"a|b": 0.6, "drag": 0.4}
    made = report(tracing=tracing(probabilities=shares, credible_set=(*shares,)))
    text = re.sub(r"\\\|", "", made.to_markdown())
    blocks = re.findall(r"(?:^\|.*\|$\n?)+", text, flags=re.MULTILINE)
    assert len(blocks) == 4
    for own in blocks:
        assert len({line.count("|") for line in own.splitlines()}) == 1


def test_save_writes_the_page_and_every_figure(tmp_path):
    page = report().save(tmp_path / "out")
    pictures = {"residuals.png", "before_after.png"}
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"report.txt", "report.md", "report.html"} | pictures
    linked = re.findall(r"\]\((.+?)\)", (page.parent / "report.md").read_text())
    assert {*linked} == pictures
    elements = Parsed(page.read_text()).elements  # the page needs no other file
    images = [own["src"] for tag, own in elements if tag == "img"]
    assert len(images) == 2
    assert all(source.startswith("data:image/svg+xml;base64,") for source in images)
    assert all(own.get("href", "#").startswith("#") for _, own in elements)
    assert not any(tag == "script" and "src" in own for tag, own in elements)
    for name in pictures:
        assert image.imread(page.parent / name).std() > 0.01  # something is drawn


# What the figures of a report draw, number by number


def points(ax):
    """Return what is drawn as points, shape (n, 2), a row each, in one order."""
    drawn = [line.get_xydata() for line in ax.lines if line.get_marker() == "."]
    return sorted(map(tuple, np.concatenate(drawn)))


@pytest.mark.parametrize("num", [1, 6])
def test_every_residual_is_drawn_at_its_action_its_trial_and_its_channel(num):
    both = residuals((num,), size=4.0), residuals((num,))
    rows = dict(zip(("bare model", "with a gain"), both, strict=True))
    figure = plot_residuals(rows, action_labels=["speed"])
    columns = 2 if num == 1 else 3
    assert len(figure.axes) == 2 * columns
    for row, (made, color) in enumerate(zip(both, (BEFORE, AFTER), strict=True)):
        panels = figure.axes[row * columns : (row + 1) * columns]
        channel = np.tile(np.arange(num), len(made.index))
        places = [np.repeat(made.action[:, 0], num), np.repeat(made.index, num)]
        for ax, place in zip(panels, [*places, channel], strict=False):
            expected = sorted(zip(place, made.refitted.ravel(), strict=True))
            np.testing.assert_allclose(points(ax), expected)
            assert {line.get_color() for line in ax.lines[:num]} == {color}


# The gate: each decision on a small case made for it


ACTIONS = DiscreteActions(torch.linspace(-2, 2, 9))


def decided(form, *, prior=PRIOR, fitted=9, held_out=4):
    """Return the gate of trials whose mean is a form of the action and its place."""
    gen = torch.Generator().manual_seed(0)
    num = fitted + held_out
    action = ACTIONS.values[torch.randperm(9, generator=gen).repeat(2)[:num]]
    mean = form(action, torch.arange(num)[:, None] < fitted)
    role = ["fit"] * fitted + ["held out"] * held_out
    trials = Trials(action, read(mean, gen), role=role)
    report = close_loop(MODEL, prior, trials, effects=[BIAS], plan=False)
    assert report.to_dict()["gate"] == json.loads(json.dumps(report.gate.to_dict()))
    assert report.gate.exit_code == EXIT_CODES[report.gate.decision]
    return report.gate


#: Mean of x, options, decision, and what holds of its details.
CASES = {
    "right": (
        lambda xi, fits: 0.7 * xi,
        *({}, "SHIP", lambda own: own["before"] < 3 * NOISE),
    ),
    "an effect is missing": (
        lambda xi, fits: 0.7 * xi + 0.8,
        *({}, "WRONG_MODEL", lambda own: own["after"] < own["before"] / 2),
    ),
    "nothing is named": (
        lambda xi, fits: 0.7 * xi + torch.sin(4 * xi),
        *({}, "WRONG_MODEL", lambda own: own["worst"]["deviations"] > 1),
    ),
    "held-out trials are missed": (
        lambda xi, fits: 0.7 * xi + torch.where(fits, 0.0, 2.0),
        *({}, "WRONG_MODEL", lambda own: len(own["trials"]) >= 3),
    ),
    "the error is no smaller": (
        lambda xi, fits: 0.7 * xi + torch.where(fits, 0.8, 0.0),
        *({}, "NO_IMPROVEMENT", lambda own: own["after"] > own["before"]),
    ),
    "a positive parameter": (
        lambda xi, fits: 0.1 * xi,
        {"prior": BoxUniform(torch.tensor([0.5]), torch.tensor([3.0]))},
        *("OUT_OF_PRIOR", lambda own: 0 < own["box"]["theta_1"]["lower"] < 0.1),
    ),
    "a truth beyond a bound, which is to be moved": (
        lambda xi, fits: 4.0 * xi,
        *({}, "OUT_OF_PRIOR", lambda own: 4.0 < own["box"]["theta_1"]["upper"] < 6.0),
    ),
    "few trials": (
        lambda xi, fits: 0.7 * xi,
        *({"fitted": 3, "held_out": 1}, "NOT_ENOUGH_DATA", lambda own: True),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_decision_has_its_details(case):
    form, options, decision, holds = CASES[case]
    gate = decided(form, **options)
    assert gate.decision == decision
    assert holds(gate.details)
    for bound in gate.details.get("bounds", ()):
        where = (bound["name"], bound["side"], bound["bound"])
        assert where in [("theta_1", "upper", 3.0), ("theta_1", "lower", 0.5)]
    is_named = decision == "WRONG_MODEL" and gate.details.get("effects") == ["bias"]
    assert is_named == (case == "an effect is missing")


def test_trajectories_that_tell_a_product_alone_are_not_identifiable():
    """Slopes from one side told both factors to a seventh, and the gate shipped."""
    times = torch.linspace(0.1, 2.0, 20)

    def swing(theta, xi):
        rate = (theta[:, :1] * theta[:, 1:]).sqrt()
        return xi * torch.cos(rate * times.to(theta))

    model = SimulatorModel(
        swing, noise=1e-3, parameter_names=["stiffness", "factor"], sample_times=times
    )
    prior = BoxUniform(torch.tensor([1.0, 0.5]), torch.tensor([20.0, 2.0]))
    gen, xi = torch.Generator().manual_seed(0), torch.linspace(0.5, 1.5, 8)[:, None]
    x = swing(torch.tensor([[9.0, 1.1]]).expand(8, -1), xi)
    x = x + 1e-3 * torch.randn(x.shape, generator=gen)
    report = close_loop(model, prior, Trials(xi, x, sample_times=times), plan=False)
    assert report.gate.decision == "NOT_IDENTIFIABLE"
    assert "stiffness" in report.gate.reason
    assert "stiffness * factor = 9.89" in str(report.combinations)
    factor = report.tracing.evidences["none"].draws[:, 1]
    # Its density falls with 1 / factor from .5 to 2.
    assert factor.std() == pytest.approx(0.427, rel=0.12)


def test_three_trials_of_which_one_contradicts():
    model = SimulatorModel(block.stop, noise=block.SENSOR)
    prior, trials = block.friction(0.1), Trials([1.0, 2.0, 3.0], [0.127, 0.510, 2.3])
    effects = generic_effects(model, trials, prior=prior)
    gate = close_loop(model, prior, trials, effects=effects, plan=False).gate
    assert gate.decision == "NOT_ENOUGH_DATA"
    assert gate.details == {"trials": ["2"]}
    assert "trial 2 does not agree" in gate.reason
