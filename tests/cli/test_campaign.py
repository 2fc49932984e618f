"""A campaign driven from the command line, as a robot's program would."""

import json
import sys
from functools import partial

import pytest

from sbi_active import CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.cli import campaign as commands
from sbi_active.cli import given, main
from tests.campaign.sizes import REFINEMENT

SIMULATOR = """
import torch


def slide(theta, action):
    friction, drag = theta[:, :1], theta[:, 1:]
    return action**2 / (2 * 9.81 * friction) / (1 + drag * action)
"""
CONFIG = """
simulator = "sled.py:slide"
theta-low = [0.2, 0.0]
theta-high = "1,1"
actions = "0.5:3"
names = "speed"
units = "m/s"
noise = 0.02
method = "nsbi"
num-simulations = 200
seed = 4
"""


@pytest.fixture
def made(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "sled", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])
    small = partial(
        CampaignOptions, details=CampaignDetails(num_scored=500), refinement=REFINEMENT
    )
    monkeypatch.setattr(commands, "CampaignOptions", small)
    (tmp_path / "sled.py").write_text(SIMULATOR)
    (tmp_path / "campaign.toml").write_text(CONFIG)
    assert main(["init", "camp", "--config", "campaign.toml"]) == 0
    assert "next: sbi-active ask camp" in capsys.readouterr().out
    return tmp_path / "camp"


def answer(capsys, *words):
    """Return what a command prints as JSON."""
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_asked_told_and_believed(made, capsys):
    asked = answer(capsys, "ask", "camp")
    assert asked["trial"] == 0
    assert asked["names"] == ["speed"]
    assert 0.5 <= asked["action"][0] <= 3
    assert answer(capsys, "ask", "camp")["action"] == asked["action"]

    told = answer(capsys, "tell", "camp", "0.7")
    assert told["x"] == [pytest.approx(0.7)]
    assert answer(capsys, "status", "camp")["not_in_belief"] == [0]
    after = answer(capsys, "update", "camp")
    assert after["not_in_belief"] == []
    assert after["belief"]["parameters"].keys() == {"theta_1", "theta_2"}
    before = {"mean": 0.6, "sd": 0.8 / 12**0.5}
    assert after["belief"]["parameters"]["theta_1"]["sd"] < before["sd"]


def test_corrected_and_withdrawn_without_the_simulator(made, capsys, tmp_path):
    main(["ask", "camp"])
    (tmp_path / "sled.py").unlink()
    assert main(["tell", "camp", "70"]) == 0
    assert main(["correct", "camp", "0", "0.7", "--reason", "told in cm"]) == 0
    (trial,) = answer_after(capsys, "status", "camp")["trials"]
    assert trial["reason"] == "told in cm"
    assert trial["x"] == [pytest.approx(0.7)]
    assert main(["withdraw", "camp", "0", "--reason", "bumped"]) == 0
    assert main(["tell", "camp", "--invalid", "--action", "2"]) == 0
    capsys.readouterr()
    statuses = [t["status"] for t in answer(capsys, "status", "camp")["trials"]]
    assert statuses == ["withdrawn", "invalid"]


def answer_after(capsys, *words):
    capsys.readouterr()
    return answer(capsys, *words)


def test_outcomes_of_a_file(made, capsys, tmp_path):
    main(["ask", "camp"])
    (tmp_path / "x.csv").write_text("distance [m]\n0.71\n")
    capsys.readouterr()
    told = answer(capsys, "tell", "camp", "--file", "x.csv")
    assert told["x"] == [pytest.approx(0.71)]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["tell", "camp", "0.7"], "expected a pending trial; got none"),
        (["tell", "camp", "1", "2", "--action", "1"], "expected 1 numbers"),
        (["tell", "camp", "fast", "--action", "1"], "write them with a point"),
        (["tell", "camp", "1", "--missing"], "got several; write one"),
        (["withdraw", "camp", "3"], "expected a trial from 0"),
        (["status", "nowhere"], "expected a campaign; got no nowhere"),
        (["init", "camp", "--config", "campaign.toml"], "choose another folder"),
        (["init", "new", "--config", "other.toml"], "expected options among"),
        (["init", "new"], "name it, as in --simulator my_robot.py:fn"),
        (["criticize", "table.csv"], "expected --simulator or --task"),
    ],
)
def test_errors_say_what_was_expected(made, capsys, tmp_path, words, text):
    (tmp_path / "other.toml").write_text("noize = 0.1\n")
    assert main(words) == 2
    assert text in capsys.readouterr().err


def test_another_place_of_the_simulator(made, capsys, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "sled.py").rename(tmp_path / "elsewhere" / "sled.py")
    del sys.modules["sled"]
    assert main(["ask", "camp"]) == 2
    assert "expected a file; got none" in capsys.readouterr().err
    assert main(["ask", "camp", "--simulator", "elsewhere/sled.py:slide"]) == 0


def test_a_slip_of_the_unit_is_named(made, capsys):
    main(["tell", "camp", "0.9", "--action", "3"])
    main(["tell", "camp", "70", "--action", "2.5"])
    main(["update", "camp"])
    shown = capsys.readouterr()
    assert "trial=1" in shown.out + shown.err


def test_exported(made, capsys, tmp_path):
    import arviz as az

    main(["tell", "camp", "0.9", "--action", "3"])
    main(["update", "camp"])
    assert main(["export", "camp", "--netcdf", "out.nc"]) == 0
    data = az.from_netcdf(tmp_path / "out.nc")
    assert data["posterior"]["theta"].shape == (4, 500, 2)


def test_a_missing_effect_is_found_and_adopted(made, capsys, monkeypatch):
    usual = given.generic_effects
    kept = {"bias", "action gain", "sensor gain"}

    def three(*arguments, **options):
        effects = usual(*arguments, **options)
        assert kept < {effect.name for effect in effects}
        return [effect for effect in effects if effect.name in kept]

    monkeypatch.setattr(given, "generic_effects", three)
    for index, speed in enumerate((0.5, 1.0, 1.5, 2.0, 2.5, 3.0)):
        distance = speed**2 / (2 * 9.81 * 0.5) / (1 + 0.3 * speed)
        slip = 0.02 * (-1) ** index
        x = f"{distance + 0.3 + slip:.4f}"  # the sensor reads 30 cm too much
        assert main(["tell", "camp", x, "--action", str(speed)]) == 0
    assert main(["criticize", "camp"]) == 0
    shown = capsys.readouterr()
    assert "Verdict: bias" in shown.out
    assert "to go on with it: sbi-active adopt camp" in shown.out
    assert main(["adopt", "camp"]) == 0
    capsys.readouterr()
    belief = answer(capsys, "status", "camp")["belief"]["parameters"]
    assert belief["theta_3"]["mean"] == pytest.approx(0.3, abs=0.06)
    assert answer(capsys, "ask", "camp")["trial"] == 6
    assert main(["report", "camp"]) == 0
    page = (made / "report.html").read_text()
    assert "bias" in page
    assert "data:image/svg+xml;base64," in page
    assert "http" not in page.replace("http-equiv", "")


EFFECTS = """
from torch.distributions import Normal
from sbi_active.criticism import Effect

offset = Effect(
    "tape slipped",
    hook="observation",
    prior=Normal(0.0, 1.0),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi,
)
own = [offset]
"""


def test_effects_of_the_command_line_for_a_campaign(
    made, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr(given, "generic_effects", lambda *_, **__: [])
    monkeypatch.delitem(sys.modules, "tape", raising=False)
    (tmp_path / "tape.py").write_text(EFFECTS)
    for index, speed in enumerate((0.5, 1.0, 1.5, 2.0, 2.5, 3.0)):
        distance = speed**2 / (2 * 9.81 * 0.5) / (1 + 0.3 * speed)
        x = f"{distance + 0.3 + 0.02 * (-1) ** index:.4f}"
        assert main(["tell", "camp", x, "--action", str(speed)]) == 0
    capsys.readouterr()
    assert main(["criticize", "camp", "--effects", "tape.py:own"]) == 0
    shown = capsys.readouterr().out
    assert "Verdict: tape slipped" in shown
    assert "sbi-active adopt camp --effects tape.py:own" in shown
    assert main(["adopt", "camp", "--effects", "tape.py:own"]) == 0
    monkeypatch.chdir(tmp_path.parent)  # where tape.py lies is remembered
    assert main(["update", str(made)]) == 0
    capsys.readouterr()
    belief = answer(capsys, "status", str(made))["belief"]["parameters"]
    assert belief["theta_3"]["mean"] == pytest.approx(0.3, abs=0.06)


def test_another_simulator_is_taken_by_the_command_line(made, capsys, tmp_path):
    main(["tell", "camp", "0.9", "--action", "3"])
    assert main(["update", "camp"]) == 0
    text = SIMULATOR.replace("2 * 9.81", "G").replace("\n\n\n", "\n\nG = 19.0\n\n", 1)
    (tmp_path / "sled.py").write_text(text)
    del sys.modules["sled"]
    assert main(["update", "camp"]) == 2
    assert "simulator_changed=True" in capsys.readouterr().err
    assert main(["update", "camp", "--simulator-changed"]) == 0
    assert main(["update", "camp"]) == 0
