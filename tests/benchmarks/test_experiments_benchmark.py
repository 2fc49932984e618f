"""The truth of a case runs the trials that a design asks for."""

import pytest
import torch

from benchmarks.experiments.reality import Reality, spread_out
from benchmarks.experiments.run import DESIGNS, lines_of
from benchmarks.misfit.cases import draw_case


@pytest.mark.parametrize(("group", "number"), [("own", 330), ("letters", 333)])
def test_a_trial_at_the_drawn_action_is_the_one_that_was_drawn(group, number):
    case = draw_case(group, "E", number)
    truth, reality = case.truth, Reality.of(case, number)
    k = int(truth.fitted[-1])  # as if it were the next one
    reality.index = k
    x = reality.run(truth.action[k])
    assert torch.allclose(x, truth.measured(torch.tensor([k]))[0])
    assert reality.index == k + 1
    other = Reality(case, reality.actions, k).run(reality.actions.values[0])
    assert not torch.allclose(other, x)
    reality.index = len(truth.action) + 1  # a place that was not drawn
    assert reality.run(truth.action[0]).isfinite().all()
    assert len(case.truth.action) == len(truth.action)


def test_spread_out_actions_are_permitted_and_apart():
    case = draw_case("own", "E", 330)
    reality = Reality.of(case, 330)
    found = spread_out(reality, 3)
    assert len(found.unique(dim=0)) == 3
    assert reality.actions.contains(found.float()).all()


def row(kind, design, named, tested=()):
    return {
        **{"group": "own", "kind": kind, "case": 6_000, "design": design},
        **{"right": ["lag"] if kind == "E" else [], "named": named, "verdict": ""},
        **{"trials": 1, "tested": [*tested], "cpu_seconds": 2.0, "stopped": ""},
    }


def test_names_are_counted_before_and_after():
    tested = {"before": "gain", "after": "lag", "held": False}
    rows = [row("E", design, ["lag"], [tested]) for design in DESIGNS]
    rows += [row("R", design, ["gain"] * (design == "random")) for design in DESIGNS]
    text = "\n".join(lines_of(rows))
    cells = {line.split(" | ")[0]: line for line in text.splitlines()}
    assert "| 0.000 (0/1)" in cells["| none"].replace("] ", "] ")
    assert cells["| chosen"].count("1.000 (1/1)") == 1
    assert cells["| random"].count("1.000 (1/1)") == 2  # an alias in R
    assert "after a wrong name held: 0.000 (0/1)" in text
