"""``sbi-active gate``: a decision for a CI, by its exit status."""

import json

from sbi_active.cli import main

SIMULATOR = """
def slide(theta, action):
    return action**2 / (19.62 * theta)
"""
OPTIONS = ["--theta-low", "0.1", "--theta-high", "1", "--noise", "0.005", "--json"]
SPEEDS = [2.5, 0.5, 3.0, 1.0, 2.0, 1.5, 2.75, 1.25]
ERRORS = [2, -3, 4, -6, 5, -1, 3, -4]  # mm


def test_a_ci_reads_the_exit_status_and_the_reason(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sled.py").write_text(SIMULATOR)
    rows = ["action_speed[m/s],x_distance[m],role"]
    for k, (v, e) in enumerate(zip(SPEEDS, ERRORS, strict=True)):
        distance = v**2 / (19.62 * 0.4) + e / 1e3
        rows.append(f"{v},{distance:.4f},{'held out' if k > 4 else 'fit'}")
    (tmp_path / "trials.csv").write_text("\n".join(rows))
    command = ["gate", "trials.csv", "--simulator", "sled.py:slide", *OPTIONS]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["decision"] == "SHIP"
    assert found["details"]["before"] < 0.02
    command[command.index("--theta-high") + 1] = "0.3"
    assert main(command) == 12
    found = json.loads(capsys.readouterr().out)
    assert found["decision"] == "OUT_OF_PRIOR"
    assert abs(found["details"]["bounds"][0]["bound"] - 0.3) < 1e-6
