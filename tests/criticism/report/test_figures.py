"""What the figures of a report draw, number by number."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from sbi_active.criticism.report.figures import (
    AFTER,
    BEFORE,
    plot_probabilities,
    plot_residuals,
)
from tests.criticism.report.reports import residuals, tracing


def points(ax):
    """Return what is drawn as points, shape (n, 2), a row each, in one order."""
    drawn = [line.get_xydata() for line in ax.lines if line.get_marker() == "."]
    return rows_in_order(np.concatenate(drawn))


def rows_in_order(rows):
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("shape", [(1,), (6,)])
def test_every_residual_is_drawn_at_its_action_its_trial_and_its_channel(shape):
    before, after = residuals(shape, size=4.0), residuals(shape)
    figure = plot_residuals(before, after, added="a gain")
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
