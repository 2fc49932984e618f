"""The page, its tables and figures."""

import re
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from matplotlib import image

from sbi_active.criticism.report.figures import (
    plot_before_after,
    plot_probabilities,
    plot_residuals,
)
from sbi_active.display import svg
from tests.criticism.report.reports import report, residuals, tracing


class Page(HTMLParser):
    """Collects what a page refers to and whether its elements are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.images += [values["src"]] if tag == "img" else []
        assert values.get("href", "#").startswith("#")
        assert not (tag == "script" and "src" in values)
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_self_contained():
    page = Page()
    page.feed(report().to_html())
    assert page.open == []
    assert len(page.images) == 3
    assert all(
        source.startswith("data:image/svg+xml;base64,") for source in page.images
    )


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
    assert len(blocks) == 6
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_save_writes_the_page_and_every_figure(tmp_path):
    made = report()
    page = made.save(tmp_path / "out")
    drawn = expected_figures(made)
    pictures = {f"{name}.png" for name in drawn}
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"report.txt", "report.md", "report.html"} | pictures
    linked = re.findall(r"\]\((.+?)\)", (page.parent / "report.md").read_text())
    assert {*linked} == pictures
    sources = re.findall(r'src="data:image/svg\+xml;base64,(.+?)"', page.read_text())
    fresh = expected_figures(made)  # a layout moves a little when it is drawn again
    for link, source in zip(linked, sources, strict=True):
        figure = drawn[link.removesuffix(".png")]
        given = image.imread(page.parent / link)
        np.testing.assert_array_equal(given, pixels(figure, 150))
        assert svg(fresh[link.removesuffix(".png")]).endswith(f",{source}")


def expected_figures(made):
    return {
        "residuals": plot_residuals(
            made.residuals,
            made.residuals_after,
            action_labels=["speed [m/s]"],
            added="drag",
        ),
        "probabilities": plot_probabilities(made.tracing),
        "before_after": plot_before_after(made.evaluation),
    }


def pixels(figure, dpi):
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return image.imread(BytesIO(buffer.getvalue()))


@pytest.mark.parametrize("shape", [(1,), (6,), (50,), (20, 2)])
def test_residual_panels_by_kind_of_observation(shape):
    times = np.linspace(0, 2, shape[0]) if shape[0] > 6 else None
    figure = plot_residuals(
        residuals(shape, size=40.0, times=times), residuals(shape, times=times)
    )
    labels = [ax.get_xlabel() for ax in figure.axes]
    last = {(1,): [], (6,): ["channel"]}.get(shape, ["time [s]"])
    assert labels == 2 * ["action 1", "trial", *last]
