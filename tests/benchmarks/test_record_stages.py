"""Stages of machines with recorded inputs, on a machine that takes none."""

import json

import torch
from torch.distributions import HalfNormal, Independent, Normal

from benchmarks.measured.record_stages import Bench, aliases, run_stages, table
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect, Trials
from tests.effects import on_outcomes

PLACES = torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None]


def line(theta, action, *, bend=0.0):
    bend = torch.as_tensor(bend, dtype=theta.dtype).reshape(-1, 1)
    return theta * action + bend * action**2


def line_bench():
    """A line with a hidden parabola; held out is what lies beyond the trials."""
    far = torch.tensor([[2.0]], dtype=torch.float64)
    kind = Independent(HalfNormal(torch.ones(1)), 1)

    def score(draws, effects):
        bend = draws[:, 1] if effects else 0.0
        x = line(draws[:, :1], far.expand(len(draws), 1), bend=bend)
        return {"far": float((x.mean() - 4.0).abs())}

    def replay(seed):
        generator = torch.Generator().manual_seed(seed)
        error = 0.01 * torch.randn(12, 1, generator=generator, dtype=torch.float64)
        return Trials(PLACES, PLACES + error)

    return Bench(
        model=SimulatorModel(line, noise=GaussianNoise(0.01)),
        prior=Independent(Normal(torch.zeros(1), 3 * torch.ones(1)), 1),
        effects=[
            Effect.keyword("bend", prior=kind),
            on_outcomes("bias", lambda x, phi, action, context: x + phi, sd=0.1),
        ],
        trials=Trials(PLACES, PLACES + 0.5 * PLACES**2),
        removals=[("bend",)],
        score=score,
        least_squares=lambda names: {
            "parameters": [1.0],
            "fitted": 0.5,
            "held": {"far": len(names)},
        },
        replay=replay,
    )


def test_stages_name_what_is_there_and_are_run_once(tmp_path, capsys):
    path = tmp_path / "out" / "rows.json"
    rows = run_stages(line_bench(), path, clean=1)
    assert [*rows] == ["recorded", "without bend", "clean 2000", "least squares"]
    recorded = rows["recorded"]
    assert recorded["verdict"] == "bend"
    assert recorded["before"]["far"] > 1
    assert recorded["after"]["far"] < 0.05
    assert "bend" not in rows["without bend"]["inclusion"]
    assert rows["clean 2000"]["verdict"] == "none"
    assert {*rows["least squares"]} == {"none", "bend"}
    assert json.loads(path.read_text()) == rows
    capsys.readouterr()
    assert run_stages(line_bench(), path, clean=1) == rows
    assert capsys.readouterr().out == ""
    text = table(rows, "m")
    assert "| recorded | bend |  |" in text
    assert "before, m: far" in text
    assert "| 1 replays of the bare model, seeds 2000 to 2000 | none (1) |" in text
    assert aliases(rows) == "Aliases named: 0 of 1 removals."
