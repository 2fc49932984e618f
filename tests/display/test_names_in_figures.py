"""Names that a user chose: money, control marks and halves of pairs."""

from dataclasses import replace

import matplotlib
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.campaign.display.page import write_page
from sbi_active.display import Page
from tests.campaign.storage.campaigns import OPTIONS

matplotlib.use("Agg")
NAMES = ["cost [$] \x07", "half \ud800", "a$b$c\\frac{"]


def test_any_name_can_be_drawn_and_read(tmp_path):
    model = SimulatorModel(
        lambda theta, action: theta * action,
        noise=GaussianNoise(0.1),
        parameter_names=NAMES,
        channel_names=NAMES,
    )
    prior = BoxUniform(torch.zeros(3), torch.ones(3))
    actions = DiscreteActions(torch.eye(3) + 1, names=NAMES, units=["$"] * 3)
    options = replace(OPTIONS, network="on demand")
    c = Campaign(model, prior, actions, seed=0, options=options)
    c.tell([0.5] * 3, trial=c.ask())
    c.update()
    page = write_page(c, tmp_path / "page.html").read_text(encoding="utf-8")
    assert "\x07" not in page
    c.plot().savefig(tmp_path / "plot.svg")
    c.history[0].design.plot().figure.savefig(tmp_path / "design.png")


def test_a_page_holds_no_control_marks():
    assert "a\ufffdb" in Page("a\x00b", []).html()
