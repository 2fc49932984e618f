"""Pages that travel: what is on them, and what a browser makes of them."""

import pytest

from sbi_active.campaign.display.page import page as campaign_page
from sbi_active.display import Page, Section, Table
from tests.campaign.storage.campaigns import MODEL, go_on, new
from tests.criticism.report.reports import report
from tests.display.browser import CHROMIUM, assert_reads_well, look

TABLE = Table(("name", "value"), [("b", "10"), ("a", "-2.5"), ("d", ""), ("c", "1e3")])


def test_all_text_is_escaped():
    table = Table(("<p>",), [("&",)])
    sections = [Section("<b>", text=["<i>"], items=["<u>"], table=table)]
    made = Page("<h>", sections, ["<q>"], badge=("<x>", "bad"), footer="<y>").html()
    for tag in ["<b>", "<i>", "<u>", "<h>", "<q>", "<x>", "<y>"]:
        assert tag not in made
        assert tag.replace("<", "&lt;").replace(">", "&gt;") in made
    assert "<td>&amp;</td>" in made


def test_tables_are_sorted_by_a_click_numbers_as_numbers(tmp_path):
    made = Page("Sorted", [Section("numbers", table=TABLE)]).html()
    frames, console = look(made, tmp_path)
    assert console == []
    ((up, down, state),) = frames["390"]["sorted"]
    assert up == ["-2.5", "10", "1e3", ""]
    assert down == ["1e3", "10", "-2.5", ""]
    assert state == "descending"
    assert frames["390"]["buttons"] == 2


def test_the_browser_sees_what_is_wrong(tmp_path):
    """Gray on gray, a word wider than the screen, and an error are found."""
    made = Page("Bad", [Section("words", text=["gray"])]).html()
    made = made.replace("<p>gray", '<p style="color:#888;background:#999">gray')
    made = made.replace("</h2>", '</h2><pre style="width:900px">wide</pre>')
    made = made.replace("<script>", "<script>console.error('broken');")
    frames, console = look(made, tmp_path)
    assert [low[0] for low in frames["390"]["low"]] == ["P"]
    assert "PRE" in frames["390"]["wide"]
    assert frames["1280"]["wide"] == []
    assert any("broken" in line for line in console)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_criticism_reads_well_in_a_browser(tmp_path):
    assert_reads_well(report().to_html(), tmp_path)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
@pytest.mark.filterwarnings("ignore")
def test_a_campaign_reads_well_in_a_browser(tmp_path):
    campaign = go_on(new(simulator=MODEL), 2)
    made = campaign_page(campaign)
    assert_reads_well(made, tmp_path)
    assert "2 trials told" in made
    assert made.count("<td>") >= 2 * len(campaign.history)
