"""The report from its parts: summary, numbers, figures, and its other forms."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib import image
from matplotlib.colors import to_hex
from sbi.utils import BoxUniform

from sbi_active.criticism import joint_prior
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.report.figures import (
    AFTER,
    BEFORE,
    plot_probabilities,
    plot_residuals,
)
from sbi_active.criticism.report.sections import head
from sbi_active.criticism.report.words import with_error
from tests.criticism.report.reports import DRAG, flat, report, residuals, tracing
from tests.display.parsed import Parsed

NONE = {"tracing": tracing("none"), "residuals_after": None}


TESTS = (
    SevereTest(action=np.array([3.0]), is_permitted=True, difference=1.234),
    SevereTest(action=np.array([4.5]), is_permitted=False, difference=56.7),
)


def test_a_dictionary_has_no_probabilities_where_they_contradict_the_verdict():
    plain = report().to_dict()
    assert plain["probabilities"] == pytest.approx(report().probabilities)
    assert plain["misfit"] is None
    withdrawn = report(tracing=tracing("unexplained", instead_of="drag")).to_dict()
    assert withdrawn["probabilities"] is withdrawn["credible_set"] is None


def test_only_a_bare_model_that_holds_is_a_stop():
    plan = replace(report().next_action, action=None)
    left, alone = (replace(plan, separates=(name,)) for name in ("none", "drag"))
    text = flat(report(next_action=plan, **NONE))
    assert "Stop: no permitted action tells more" in text
    text = flat(report(next_action=left, **NONE))
    assert "Stop: of the declared models only none is left." in text
    text = flat(report(next_action=alone))
    assert "Of the declared models only drag is left." in text


def test_a_verdict_that_is_not_the_likeliest_model_says_why():
    shares = {"scatter": 0.11, "tilt": 0.46, "drag": 0.43}
    made = tracing("scatter", probabilities=shares, credible_set=("tilt", "drag"))
    assert str(report(tracing=made)).splitlines()[0] == (
        "Verdict: scatter (P = 0.11), though tilt is likelier (P = 0.46), which is not "
        "shown to predict other trials better"
    )
    assert "likelier" not in str(report())


def test_a_deviation_needs_draws_behind_it():
    made = tracing()
    estimates = [replace(e, effective_sample_size=49.0) for e in made.estimates]
    few = replace(
        made.evidences["none"], effective_sample_size=2.2, draws=np.full((400, 2), 0.1)
    )
    evidences = made.evidences | {"none": few}
    text = flat(
        report(tracing=replace(made, estimates=(*estimates,), evidences=evidences))
    )
    assert "about 0.12 1/m" in text
    assert "mu_1 about 0.1 " in text
    assert '"about": below 50 effective samples' in text
    assert "(more than 1000 of its standard deviations)" in text
    assert "about" not in flat(report()).split("Parameters")[1].split("Next")[0]


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (0.35992, 0.00071, "0.35992 +- 0.00071"),
        (-1234.56, 56.7, "-1235 +- 57"),
        (0.3, 0.0996, "0.30 +- 0.10"),
        (2.0, 0.0, "2 +- 0"),
        (np.nan, np.nan, ""),
    ],
)
def test_numbers_have_the_digits_that_their_deviation_leaves(mean, sd, text):
    assert with_error(mean, sd) == text


def test_a_report_goes_through_json_with_all_sections():
    made = report(severe_tests=TESTS)
    again = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert again["verdict"] == "drag"
    assert " ".join(again["summary"]) == " ".join(head(made)[1:])
    assert again["next_action"]["action"] == [3.0]
    assert len(again["residuals_by_trial"]) == 8
    titles = [section["title"] for section in again["sections"]]
    assert titles == [t for t in str(made).splitlines() if t in titles]
    assert again["sections"][0]["table"]["header"][0] == "model"


def test_a_report_pickles_with_effects_that_are_local_functions():
    made = report(prior=joint_prior(BoxUniform(torch.zeros(2), torch.ones(2)), [DRAG]))
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        pickle.dumps(DRAG)
    again = pickle.loads(pickle.dumps(made))
    assert str(again) == str(made)
    assert again.prior.sample((4,)).shape == (4, 3)
    theta, action = torch.ones(2, 2), torch.ones(2, 1)
    assert (again.simulator.mean(theta, action) == 1).all()


# The page, its tables and figures


def test_the_page_is_self_contained():
    elements = Parsed(report().to_html()).elements
    images = [attributes["src"] for tag, attributes in elements if tag == "img"]
    assert len(images) == 3
    assert all(source.startswith("data:image/svg+xml;base64,") for source in images)
    assert all(own.get("href", "#").startswith("#") for _, own in elements)
    assert not any(tag == "script" and "src" in own for tag, own in elements)


def test_markdown_tables_have_as_many_cells_as_headings():
    shares = {"a|b": 0.6, "drag": 0.4}
    made = report(tracing=tracing(probabilities=shares, credible_set=(*shares,)))
    text = re.sub(r"\\\|", "", made.to_markdown())
    blocks = re.findall(r"(?:^\|.*\|$\n?)+", text, flags=re.MULTILINE)
    assert len(blocks) == 4
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_save_writes_the_page_and_every_figure(tmp_path):
    page = report().save(tmp_path / "out")
    pictures = {"residuals.png", "probabilities.png", "before_after.png"}
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"report.txt", "report.md", "report.html"} | pictures
    linked = re.findall(r"\]\((.+?)\)", (page.parent / "report.md").read_text())
    assert {*linked} == pictures
    assert page.read_text().count("data:image/svg+xml;base64,") == 3
    for name in pictures:
        assert image.imread(page.parent / name).std() > 0.01  # something is drawn


# What the figures of a report draw, number by number


def points(ax):
    """Return what is drawn as points, shape (n, 2), a row each, in one order."""
    drawn = [line.get_xydata() for line in ax.lines if line.get_marker() == "."]
    return rows_in_order(np.concatenate(drawn))


def rows_in_order(rows):
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("shape", [(1,), (6,)])
def test_every_residual_is_drawn_at_its_action_its_trial_and_its_channel(shape):
    before, after = residuals(shape, size=4.0), residuals(shape)
    figure = plot_residuals(before, after, action_labels=["speed"], added="a gain")
    columns = 2 if shape == (1,) else 3
    assert len(figure.axes) == 2 * columns
    for row, (made, color, title) in enumerate(
        [(before, BEFORE, "bare model"), (after, AFTER, "with a gain")]
    ):
        panels = figure.axes[row * columns : (row + 1) * columns]
        num = shape[0]
        channel = np.tile(np.arange(num), len(made.index))
        places = [np.repeat(made.action[:, 0], num), np.repeat(made.index, num)]
        for ax, place in zip(panels, [*places, channel], strict=False):
            expected = np.column_stack([place, made.refitted.ravel()])
            np.testing.assert_allclose(points(ax), rows_in_order(expected))
            assert {line.get_color() for line in ax.lines[:num]} == {color}
        assert panels[0].get_ylabel().startswith(title)


def test_bars_are_as_long_as_probabilities_the_most_probable_on_top():
    shares = {"drag": 0.6, "tilt": 0.33, "drag + tilt": 0.015, "none": 0.001}
    shares |= {"drag + bias": 0.004, "scatter": 0.05}
    found = tracing(probabilities=shares, credible_set=("drag", "tilt"))
    (ax,) = plot_probabilities(found).axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["none", "drag + tilt", "scatter", "tilt", "drag"]  # upwards
    assert [bar.get_width() for bar in ax.patches] == [shares[n] for n in names]
    filled = {n for n, b in zip(names, ax.patches, strict=True) if is_filled(b)}
    assert filled == {"drag", "tilt"}
    texts = [text.get_text() for text in ax.texts]
    assert texts == ["< 0.01", "0.01", "0.05", "0.33", "0.60"]
    (ax,) = plot_probabilities(found, at_most=2).axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["tilt", "drag"]


def is_filled(bar):
    return to_hex(bar.get_facecolor()) == AFTER
