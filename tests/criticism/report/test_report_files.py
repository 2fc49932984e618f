"""The page, its tables and figures."""

import re
from html.parser import HTMLParser

from matplotlib import image

from tests.criticism.report.reports import report, tracing


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
