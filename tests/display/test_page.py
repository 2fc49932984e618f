"""Pages that travel: what is on them."""

from sbi_active.display import Page, Section, Table


def test_all_text_is_escaped():
    table = Table(("<p>",), [("&",)])
    sections = [Section("<b>", text=["<i>"], items=["<u>"], table=table)]
    made = Page("<h>", sections, ["<q>"], badge=("<x>", "bad"), footer="<y>").html()
    for tag in ["<b>", "<i>", "<u>", "<h>", "<q>", "<x>", "<y>"]:
        assert tag not in made
        assert tag.replace("<", "&lt;").replace(">", "&gt;") in made
    assert "<td>&amp;</td>" in made
