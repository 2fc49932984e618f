"""The snippets of the README and the docs run as printed, each on its own.

A snippet whose first line is ``# name.py`` is a file, from which others may import.
"""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sbi_active import InformationGainDesigner
from sbi_active.campaign.learning import planner
from sbi_active.campaign.learning.learner import Learner
from sbi_active.design import GradientSearch
from sbi_active.inference.networks.mixture_density import TrainingRecord, train_network
from sbi_active.inference.trainers import action_rounds

ROOT = Path(__file__).parents[1]
FILE = re.compile(r"# (\w+)\.py\n")
#: A part of what a page prints. A page that is not here only has to run; those with a
#: test of their own are left out of the others.
PRINTED = {
    "docs/overview.md": "theta[theta_1]",
    "docs/simulations.md": "{'ok': 3, 'invalid': 0, 'missing': 0}",
    "docs/identifiability.md": "known: friction * (mass + 0.5) = ",
    "docs/methods.md": "trial 2",
    "docs/seeing.md": "speed [m/s]  distance  information_gained health",
    "docs/campaigns.md": "Belief(refined",
    "docs/pouring.md": "'mesh coverage': torch.Size([1, 36])",
    "docs/robots.md": "x depends on them through mass / gear alone",
    "docs/start.md": "Belief(refined: friction",
    "docs/howto/which_parameters.md": "friction * mass",
    "docs/howto/gate.md": "SHIP: ",
    "docs/howto/recordings.md": "Verdict: rail friction loss (P = 0.99",
}
NEEDED = {"docs/pouring.md": "pybullet", "docs/howto/recordings.md": "mcap"}
DEAR = ("docs/methods.md", "docs/robots.md", "docs/howto/recordings.md")
OWN = ("README.md", "docs/closing_the_loop.md", "docs/howto/thrown_ball.md")
PAGES = sorted(
    str(page.relative_to(ROOT))
    for page in (ROOT / "docs").rglob("*.md")
    if "```python" in page.read_text() and "_build" not in page.parts
)

pytestmark = [
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.filterwarnings("error:sbi_active.* goes in the next version"),
]


@pytest.fixture
def run(tmp_path, monkeypatch, few_draws):
    """Return a function that runs a page, and returns the names of each snippet.

    README runs as printed. On the other pages a network is trained where something asks
    for it, and soon, and a search for the next action is short and of few simulations.
    """
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    forget()  # those of other tests

    def page(name: str) -> list[SimpleNamespace]:
        ran = []
        if name != "README.md":
            monkeypatch.setattr(GradientSearch, "num_rounds", 1)
            monkeypatch.setattr(GradientSearch, "num_starts", 4)
            monkeypatch.setattr(planner, "InformationGainDesigner", of_few_simulations)
            monkeypatch.setattr(Learner, "trains_each_round", False)
            monkeypatch.setattr(action_rounds, "train_network", of_few_steps)
        text = (ROOT / name).read_text()
        for snippet in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            file = FILE.match(snippet)
            if file is not None:
                (tmp_path / f"{file.group(1)}.py").write_text(snippet)
                ran.append(__import__(file.group(1)))
            else:
                names: dict = {}
                exec(compile(snippet, name, "exec"), names)
                ran.append(SimpleNamespace(**names))
        return ran

    yield page
    forget()


def of_few_simulations(actions, **options) -> InformationGainDesigner:
    return InformationGainDesigner(actions, **{**options, "num_samples": 100})


def of_few_steps(*args, num_iterations, **options) -> TrainingRecord:
    return train_network(*args, num_iterations=min(num_iterations, 20), **options)


def forget():
    """Forget the modules that pages and other tests have written."""
    for name in [name for name in sys.modules if name.startswith("my_")]:
        del sys.modules[name]


def test_readme(run, capsys):
    (campaign,) = run("README.md")
    assert "Design(action [4], EIG" in capsys.readouterr().out
    assert len(campaign.campaign.history) == 3
    deviation = campaign.belief.variance.sqrt()
    assert (deviation < torch.tensor([0.03, 0.06])).all()  # of priors .26 wide
    truth = torch.tensor([0.4, 0.3])
    assert ((campaign.belief.mean - truth).abs() < 4 * deviation).all()
    assert not campaign.belief.diagnostics.combinations


@pytest.mark.slow
def test_closing_the_loop(run, capsys):
    pages = run("docs/closing_the_loop.md")
    _, bare, _, forces, drag, decides, starts, campaign, *motor = pages
    printed = capsys.readouterr().out
    assert bare.report.verdict == "unexplained"
    overview = (ROOT / "docs/overview.md").read_text()
    (begins,) = re.findall(r"```text\n(Verdict.*?)```", overview, re.DOTALL)
    assert printed.startswith(f"unexplained\n{begins}")
    assert "P holds among the declared effects alone" in " ".join(printed.split())
    table = drag.report.before_after.set_index("metric")
    # Four numbers with a noise of 5 mm: the standard error of their RMSE is 1.8 mm.
    assert table.loc["rmse", "after"] < 0.005 + 4 * 0.0018
    assert table.loc["rmse", "ratio"] < 0.5
    assert drag.page.exists()
    assert decides.report.verdict == "drag"
    assert 1 <= len(decides.report.tested) <= 3
    assert starts.loop.trace().verdict == "drag"
    assert "sin 2q of hinge" in [effect.name for effect in forces.effects]
    assert "alarm\n('drag',)\n" in printed
    *_, found, names = printed.splitlines()
    assert found == "dead zone"
    assert names == "['amplitude', 'end frequency'] True"
    assert motor[-1].series.shape == (101,)
    truth = torch.tensor([0.4, 0.3])
    belief = campaign.campaign.belief
    assert ((belief.mean - truth).abs() < 4 * belief.variance.sqrt()).all()


def test_question_thrown_ball(run, capsys):
    (ball,) = run("docs/howto/thrown_ball.md")
    assert ball.report.verdict == "drag"
    (line,) = [t for t in capsys.readouterr().out.splitlines() if t[:9] == "drag [1/m"]
    mean, sd = (float(v) for v in line.split("]")[1].split("+-"))
    assert abs(mean - 0.05) < 3 * sd < 0.05  # of the film's
    table = ball.report.before_after.set_index("metric")
    # Errors of a camera of 1 cm, and of starts that its first frames tell.
    assert table.loc["rmse", "after"] < 0.03 < table.loc["rmse", "before"]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page in DEAR else [])
        for page in PAGES
        if page not in OWN
    ],
)
def test_a_page_runs_and_prints_what_it_says(page, run, capsys):
    if page in NEEDED:
        pytest.importorskip(NEEDED[page])
    assert run(page)
    assert PRINTED.get(page, "") in capsys.readouterr().out
