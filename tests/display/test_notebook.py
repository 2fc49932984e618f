"""The small pages that notebooks show."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from sbi_active import (
    BoxActions,
    Campaign,
    SimulatorModel,
)
from sbi_active.inference.beliefs.belief import UnchangedBelief
from sbi_active.inference.beliefs.diagnostics import Diagnostics
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
    actions = BoxActions([0.5], [2.0], names=[f"speed {EVIL}"], units=["m/s"])
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


def test_a_belief_has_each_parameter_and_what_speaks_against_it():
    belief = UnchangedBelief(PRIOR, PRIOR)
    belief.parameter_names = ("mass", "friction")
    belief.diagnostics = Diagnostics().warned(f"beware of {EVIL}")
    page = page_of(belief)
    assert {"mass", "friction", "not trustworthy", f"beware of {EVIL}"} <= {*page.texts}
