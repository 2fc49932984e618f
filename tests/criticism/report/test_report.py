"""The report from its parts: summary, numbers, figures, and its other forms."""

import json
import pickle
import re

import numpy as np
import pytest
import torch
from matplotlib import image

from sbi_active.criticism.contradictions import SevereTest
from sbi_active.display.panels import AFTER, BEFORE, plot_residuals
from tests.criticism.report.reports import DRAG, report, residuals, tracing
from tests.display.browser import Parsed

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
    (summary,) = again["summary"]
    assert summary in " ".join(str(made).split())
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
    pictures = {"residuals.png"}
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"report.txt", "report.md", "report.html"} | pictures
    linked = re.findall(r"\]\((.+?)\)", (page.parent / "report.md").read_text())
    assert {*linked} == pictures
    elements = Parsed(page.read_text()).elements  # the page needs no other file
    images = [own["src"] for tag, own in elements if tag == "img"]
    assert len(images) == 1
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
