"""The small pages that notebooks show."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
import torch

from sbi_active import Campaign, DiscreteActions, RandomDesigner, SimulatorModel
from sbi_active.display.notebook import badge, card, facts, items, table
from sbi_active.display.table import Table
from tests.campaign.storage.campaigns import MODEL, OPTIONS, PRIOR, outcome

EVIL = '<script>alert("&")</script>'
VOID = {"br", "img"}


class Page(HTMLParser):
    """Text and tags of a page, which must be balanced."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.open, self.texts = [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            assert name in ("style", "title"), name
            # On a dark page nothing may be black, on a light one nothing white.
            for color in re.findall(r"(?:color|background):([^;]*)", value):
                assert color not in ("black", "white", "#000", "#fff"), color

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    @property
    def text(self):
        return " ".join(self.texts)


def page_of(thing):
    html = thing._repr_html_()
    assert len(html) < 20_000
    assert "http" not in html
    page = Page(html)
    assert "script" not in page.tags
    return page


@pytest.fixture(scope="module")
def campaign():
    model = SimulatorModel(
        MODEL.fn, noise=MODEL.noise, parameter_names=["mass", EVIL[:8]]
    )
    actions = DiscreteActions([0.5, 2.0], names=[f"speed {EVIL}"], units=["m/s"])
    options = replace(OPTIONS, network="on demand")
    c = Campaign(model, PRIOR, actions, options=options)
    c.ask()
    c.tell(outcome(c.pending.action, 0))
    c.update()
    c.ask()
    return c


def test_a_campaign_has_its_health_belief_and_trials(campaign):
    page = page_of(campaign)
    assert "Campaign: asbi, 1 trials, trial 1 pending" in page.text
    assert "health ok" in page.texts
    assert "mass" in page.texts
    assert EVIL[:8] in page.texts
    assert any(text.startswith(f"speed {EVIL}") for text in page.texts)
    mean = f"{campaign.belief.quick_sample(2_000, seed=0)[:, 0].double().mean():.4g}"
    assert mean in page.texts


def test_looking_at_a_belief_draws_nothing_from_the_global_generator(campaign):
    before = torch.get_rng_state()
    campaign.belief._repr_html_()
    assert torch.equal(torch.get_rng_state(), before)


def test_a_design_has_the_chosen_and_the_best_candidates(campaign):
    design = campaign.pending.design
    page = page_of(design)
    assert page.texts.count("chosen") == 1
    assert f"{float(design.expected_information_gain[design.index]):.3g}" in page.texts
    pairs = DiscreteActions([[0.0, 1.0], [1.0, 2.0]], names=["a", "b"])
    page = page_of(RandomDesigner(pairs).select(seed=0))
    assert {"a", "b", "chosen"} <= {*page.texts}


def test_pieces_are_escaped():
    pieces = [
        card(EVIL),
        card("title", EVIL),
        table(Table([EVIL], [[EVIL]])),
        badge(EVIL),
        facts([(EVIL, EVIL)]),
        items([EVIL]),
        table(Table.of_parameters([EVIL], torch.randn(20, 1))),
    ]
    for piece in pieces:
        assert EVIL in Page(piece).texts
