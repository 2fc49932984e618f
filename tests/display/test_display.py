"""Tables, notebooks and pages that travel, with names that a user chose."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from attrs import evolve
from sbi.utils import BoxUniform

from sbi_active import BoxActions, Campaign, DiscreteActions, SimulatorModel
from sbi_active.design.design import Design
from sbi_active.display import Page, Section, Table
from sbi_active.display.campaign_page import page as campaign_page
from sbi_active.display.figures import legible
from sbi_active.display.notebook import badge, card, facts, items, table
from tests.campaign.storage.campaigns import MODEL, OPTIONS, PRIOR, go_on, new, outcome
from tests.criticism.report.reports import report
from tests.display.browser import CHROMIUM, Parsed, assert_reads_well, look

TABLE = Table(("model", "P"), [("bare", 0.25), ("drag|lift", "0.7")])


def test_a_table_stands_in_columns():
    head, rule, *rows = TABLE.text().splitlines()
    assert {*rule} == {"-", " "}
    edges = [i + 1 for i, a in enumerate(rule) if rule[i + 1 : i + 2] in ("", " ")]
    assert edges[-1] == len(rule)
    for line, cells in zip([head, *rows], [TABLE.header, *TABLE.rows], strict=True):
        assert line.split() == [*map(str, cells)]
        assert line.startswith(str(cells[0]))
        assert len(line) == len(rule)


def test_a_data_frame_is_shown_without_what_is_not_known():
    nan = float("nan")
    rows = {"trial": [0, 1], "gain": [0.123456, nan], "none": [nan] * 2}
    table = Table.of(pd.DataFrame(rows))
    assert table.header == ["trial", "gain"]
    assert table.rows == [["0", "0.1235"], ["1", ""]]


def test_parameters_have_mean_deviation_and_interval():
    draws = torch.linspace(0.0, 1.0, 101)[:, None]
    ((name, mean, sd, interval),) = Table.of_parameters(["mass"], draws).rows
    assert (name, float(mean), float(sd)) == ("mass", 0.5, 0.29)
    assert interval == "0.05 to 0.95"


# Names that a user chose: money, control marks and halves of pairs


plt.switch_backend("Agg")


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


NAMES = ["cost [$] \x07", "half \ud800", "a$b$c\\frac{"]


def test_any_name_can_be_drawn_and_read(tmp_path):
    named = {"parameter_names": NAMES, "channel_names": NAMES}
    model = SimulatorModel(lambda t, a: t * a, noise=0.1, **named)
    prior = BoxUniform(torch.zeros(3), torch.ones(3))
    actions = DiscreteActions(torch.eye(3) + 1, names=NAMES, units=["$"] * 3)
    options = evolve(OPTIONS, network="on demand")
    c = Campaign(model, prior, actions, seed=0, options=options)
    c.tell([0.5] * 3, trial=c.ask())
    c.update()
    page = campaign_page(c)
    assert "\x07" not in page
    page.encode()
    c.plot().savefig(tmp_path / "plot.svg")
    c.history[0].design.plot().figure.savefig(tmp_path / "design.png")


# The small pages that notebooks show


EVIL = '<script>alert("&")</script>'


def shown(html):
    """Return a piece that a notebook shows, which brings no color of its own page."""
    page = Parsed(html)
    assert "script" not in {tag for tag, _ in page.elements}
    for _, attributes in page.elements:
        assert {*attributes} <= {"style", "title"}
        # On a dark page nothing may be black, on a light one nothing white.
        style = attributes.get("style", "")
        colors = re.findall(r"(?:color|background):([^;]*)", style)
        assert not {*colors} & {"black", "white", "#000", "#fff"}
    return page


def page_of(thing):
    html = thing._repr_html_()
    assert len(html) < 20_000
    assert "http" not in html
    return shown(html)


@pytest.fixture(scope="module")
def campaign():
    names = ["mass", EVIL[:8]]
    model = SimulatorModel(MODEL.fn, noise=MODEL.noise, parameter_names=names)
    actions = DiscreteActions([0.5, 2.0], names=[f"speed {EVIL}"], units=["m/s"])
    options = evolve(OPTIONS, network="on demand")
    c = Campaign(model, PRIOR, actions, options=options)
    c.ask()
    c.tell(outcome(c.pending.action, 0))
    c.update()
    c.ask()
    return c


def test_a_campaign_has_its_health_belief_and_trials(campaign):
    page = page_of(campaign)
    assert "Campaign: asbi, 1 trials, trial 1 pending" in " ".join(page.texts)
    assert {"health ok", "mass", EVIL[:8]} <= {*page.texts}
    assert any(text.startswith(f"speed {EVIL}") for text in page.texts)
    mean = f"{campaign.belief.quick_sample(2_000, seed=0)[:, 0].double().mean():.4g}"
    assert mean in page.texts
    before = torch.get_rng_state()
    campaign.belief._repr_html_()
    assert torch.equal(torch.get_rng_state(), before)


def test_pieces_are_escaped():
    tables = Table([EVIL], [[EVIL]]), Table.of_parameters([EVIL], torch.randn(20, 1))
    pieces = [card(EVIL), card("title", EVIL), badge(EVIL), items([EVIL])]
    for piece in [*pieces, facts([(EVIL, EVIL)]), *map(table, tables)]:
        assert EVIL in shown(piece).texts


# Pages that travel: what is on them, and what a browser makes of them


def test_all_text_is_escaped():
    table = Table(("<p>",), [("&",)])
    sections = [Section("<b>", text=["<i>"], items=["<u>"], table=table)]
    made = Page("<h>\x00", sections, ["<q>"], badge=("<x>", "bad"), footer="<y>").html()
    for name in "biuhqxy":
        assert f"<{name}>" not in made
        assert f"&lt;{name}&gt;" in made
    assert "<td>&amp;</td>" in made
    assert "\ufffd" in made
    assert "\x00" not in made  # nor control marks


def test_tables_are_sorted_by_a_click_numbers_as_numbers(tmp_path):
    rows = [("b", "10"), ("a", "-2.5"), ("d", ""), ("c", "1e3")]
    numbers = Table(("name", "value"), rows)
    made = Page("Sorted", [Section("numbers", table=numbers)]).html()
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


def test_ticks_of_a_logarithm_are_numbers():
    figure, (left, right) = plt.subplots(1, 2)
    left.set(yscale="log", ylim=(1e-3, 1e3))
    right.set_yscale("symlog", linthresh=2)
    right.set_ylim(-100, 100)
    legible(figure).canvas.draw()
    texts = [text.get_text() for ax in (left, right) for text in ax.get_yticklabels()]
    assert {"0.01", "1", "\N{MINUS SIGN}10"} <= {*texts}
    assert "$" not in "".join(texts)


# What the picture of a design draws, for each kind of action


def design(actions):
    rows = actions.sample((30,), seed=0)
    gain = rows.double().square().sum(1)
    error = [torch.full_like(gain, 0.05)] * 4
    made = {"bound": "lower", "index": 4, "num_simulations": 30}
    return Design(rows[4], rows, gain, *error, **made, labels=actions.entry_labels)


PUSHES = BoxActions([0.0, -1.0], [2.0, 1.0], names=["speed", "tilt"], units=["m/s", ""])


def test_two_entries_make_a_map_with_every_candidate_and_the_chosen_one():
    made = design(PUSHES)
    ax = made.plot()
    (marks,) = [c for c in ax.collections if len(c.get_offsets()) > 1]
    np.testing.assert_allclose(marks.get_offsets(), made.candidates)
    np.testing.assert_allclose(marks.get_array(), made.expected_information_gain)
    (chosen,) = [each for each in ax.lines if each.get_label() == "chosen"]
    np.testing.assert_allclose(chosen.get_xydata()[0], made.action)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("speed [m/s]", "tilt")
    assert [a.get_ylabel() for a in ax.figure.axes][1:] == ["EIG (lower bound) [nats]"]


def test_more_entries_make_candidates_in_order() -> None:
    made = design(BoxActions([0.0] * 3, [1.0] * 3))
    ax = made.plot()
    gain = made.expected_information_gain.sort(descending=True).values
    np.testing.assert_allclose(ax.lines[0].get_ydata(), gain)
    (chosen,) = [each for each in ax.lines if each.get_label() == "chosen"]
    place = int(chosen.get_xdata()[0])
    assert float(gain[place]) == float(made.expected_information_gain[made.index])
