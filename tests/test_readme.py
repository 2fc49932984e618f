"""The snippets of the README and the docs run as printed, each on its own.

A snippet whose first line is ``# name.py`` is a file, from which others may import.
"""

import re
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sbi_active.campaign.learning.learner import Learner
from sbi_active.design import GradientSearch, designer

ROOT = Path(__file__).parents[1]
FILE = re.compile(r"# (\w+)\.py\n")

pytestmark = [
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.filterwarnings("error:sbi_active.* goes in the next version"),
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return a function that runs a page, and returns the names of each snippet.

    README runs as printed. On the other pages a network is trained where something asks
    for it, and a search for the next action is short.
    """
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    forget()  # those of other tests

    def page(name: str) -> list[SimpleNamespace]:
        ran = []
        if name != "README.md":
            quick = partial(GradientSearch, num_rounds=1, num_starts=4)
            monkeypatch.setattr(designer, "GradientSearch", quick)
            monkeypatch.setattr(Learner, "trains_each_round", False)
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


def test_overview(run, capsys):
    (style,) = run("docs/overview.md")
    assert "theta[theta_1]" in capsys.readouterr().out
    assert len(style.inference.trials) == 2


def test_simulations(run, capsys):
    bank = run("docs/simulations.md")[-1]
    printed = capsys.readouterr().out
    assert "tensor([0.1274, 0.5097, 1.1468])" in printed
    assert "{'ok': 3, 'invalid': 0, 'missing': 0}" in printed
    # A quarter of the prior's rows lie in the narrower box, all with the same weight.
    assert 80 < bank.reused.effective_sample_size < 170


def test_identifiability(run, capsys):
    campaign, apart = run("docs/identifiability.md")
    printed = capsys.readouterr().out
    through = "friction * (mass + 0.5)"
    assert f"x depends on them through {through} alone" in printed
    assert f"known: {through} = " in printed
    (known,) = campaign.belief.diagnostics.combinations.known
    assert abs(known.value - 0.6) < 3 * (known.high - known.low)
    assert apart.report.undetermined == ()


@pytest.mark.slow
def test_methods(run, capsys):
    alhi, corrections = run("docs/methods.md")
    # One trial of action 1 with a noise of .1: x, and so the mean, is within .4 of .5.
    assert (alhi.belief.mean - 0.5).abs() < 0.4
    assert "trial 2" in capsys.readouterr().out
    history = corrections.campaign.history
    assert [trial.status for trial in history] == ["ok", "withdrawn", "ok"]
    assert history[2].x == pytest.approx(0.42)


def test_closing_the_loop(run, capsys):
    pages = run("docs/closing_the_loop.md")
    _, bare, _, forces, drag, decides, starts, campaign, *motor = pages
    printed = capsys.readouterr().out
    assert bare.report.verdict == "unexplained"
    (begins,) = re.findall(
        r"```text\n(Verdict.*?)```", (ROOT / "docs/overview.md").read_text(), re.DOTALL
    )
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


def test_seeing(run, capsys, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    (page,) = run("docs/seeing.md")
    assert "speed [m/s]  distance  information_gained health" in capsys.readouterr().out
    assert len(page.table) == 4
    for name in ("campaign.png", "design.png"):
        assert Path(name).stat().st_size > 10_000
    belief = page.campaign.belief
    assert belief.parameter_names == ("friction", "drag")
    assert ((belief.mean - page.truth).abs() < 4 * belief.variance.sqrt()).all()


def test_campaigns(run, capsys):
    (page,) = run("docs/campaigns.md")
    assert "Belief(refined" in capsys.readouterr().out
    assert [t.status for t in page.campaign.history] == ["ok", "ok"]
    assert page.campaign.history[1].reason == "read off the wrong tape"


def test_pouring(run, capsys):
    pytest.importorskip("pybullet")
    page, material = run("docs/pouring.md")
    assert page.image.shape == (22_500,)
    printed = capsys.readouterr().out
    assert "'mesh coverage': torch.Size([1, 36])" in printed
    assert material.task.material == "gravel"
    assert material.real.shape == (22_500,)


@pytest.mark.slow
def test_robots(run, capsys):
    cart, verdict, motion = run("docs/robots.md")
    printed = capsys.readouterr().out
    assert "x depends on them through mass / gear alone" in printed
    assert {t.action[1].item() for t in cart.campaign.history} == {0.0, 1.0}
    belief = cart.campaign.belief
    assert ((belief.mean - cart.truth[0]).abs() < 4 * belief.variance.sqrt()).all()
    assert verdict.report.verdict == "hinge friction loss"
    assert motion.design.estimator == "LinearGain"
    assert motion.limits(motion.design.action[None]).all()


def test_getting_started(run, capsys):
    (page,) = run("docs/start.md")
    assert "Belief(refined: friction" in capsys.readouterr().out
    assert len(page.campaign.history) == 1


def test_question_how_many_simulations(run):
    (enough,) = run("docs/howto/how_many_simulations.md")
    assert 0 < enough.found.num_simulations <= 3_000


def test_question_failed_trial(run):
    (failed,) = run("docs/howto/failed_trial.md")
    assert [t.status for t in failed.campaign.history] == ["invalid", "missing"]
    # Off the table, further than 1 m: friction is below what slides as far.
    speed = failed.campaign.history[0].action
    assert failed.campaign.belief.mean < speed**2 / (2 * 9.81)


def test_question_which_parameters(run, capsys):
    run("docs/howto/which_parameters.md")
    assert "friction * mass" in capsys.readouterr().out


def test_question_target(run):
    (asked,) = run("docs/howto/target.md")
    assert (float(asked.every.action), float(asked.own.action)) == (1.0, 0.0)
    gain, error = asked.own.expected_information_gain, asked.own.standard_error
    assert abs(float(gain[1])) < 0.05 + 3 * float(error[1])  # ice: nothing of it


def test_question_two_models(run):
    (rivals,) = run("docs/howto/two_models.md")
    assert rivals.actions.contains(torch.as_tensor(rivals.found.action)[None]).all()


def test_question_gate(run, capsys):
    (own,) = run("docs/howto/gate.md")
    assert (own.gate.decision, own.gate.exit_code) == ("SHIP", 0)
    assert capsys.readouterr().out.startswith("SHIP: ")


def test_question_thrown_ball(run, capsys):
    (ball,) = run("docs/howto/thrown_ball.md")
    assert ball.report.verdict == "drag"
    (line,) = [t for t in capsys.readouterr().out.splitlines() if t[:9] == "drag [1/m"]
    mean, sd = (float(v) for v in line.split("]")[1].split("+-"))
    assert abs(mean - 0.05) < 3 * sd < 0.05  # of the film's
    table = ball.report.before_after.set_index("metric")
    # Errors of a camera of 1 cm, and of starts that its first frames tell.
    assert table.loc["rmse", "after"] < 0.03 < table.loc["rmse", "before"]


def test_question_recordings(run, capsys):
    pytest.importorskip("mcap")
    log, read = run("docs/howto/recordings.md")
    assert log.robot.trials.x.shape == (4, 150, 2)
    assert log.robot.trials.x[0, :, 0].isfinite().sum() == 30
    assert log.robot.trials.sample_times[-1].item() == pytest.approx(2.98)
    assert log.report.verdict == "rail friction loss"
    printed = capsys.readouterr().out
    assert (
        "('rail [m]', 'swing [rad]')\nVerdict: rail friction loss (P = 0.99" in printed
    )
    assert list(read.frame.columns) == ["time", "angle", "motor"]
    assert read.frame.time.iloc[-1] == pytest.approx(0.99)
    assert read.frame.angle.iloc[-1] == pytest.approx(0.99)
    assert not read.frame.isna().any().any()


def test_question_warnings(run):
    (page,) = run("docs/howto/warnings.md")
    assert page.title == "Rows missing"


def test_no_page_is_forgotten():
    ran = {*re.findall(r'run\("(.*?)"\)', Path(__file__).read_text())}
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    assert ran == {
        str(page.relative_to(ROOT))
        for page in pages
        if "```python" in page.read_text() and "_build" not in page.parts
    }


def test_robust_updates(run):
    snippet, plane = run("docs/robust.md")
    assert snippet.model.misspecified(snippet.x, torch.tensor([0.0, 30.0]))[0, 1] > 0.99
    assert plane.problem.parameter_names == ["friction"]
    assert float(plane.friction.mean()) == pytest.approx(0.12, abs=0.03)


def test_trust(run, capsys):
    network, belief, export = run("docs/trust.md")
    assert network.calibration.overall.num_rows == 300
    assert len(belief.check.spread) == 2
    assert "friction" in capsys.readouterr().out
    assert export.tree.groups
