"""Attacks on campaigns by what is told: bad numbers, corrections, other types."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.campaign_problem import (
    ACTIONS,
    BIAS,
    METHODS,
    MODEL,
    PRIOR,
    TOLD,
    TRUTH,
    campaign,
    doubted,
    draws,
    noisy,
    refused,
    right,
    same,
    tell,
)
from sbi_active.campaign.options import CampaignDetails

ATTACKS = Attacks()


@ATTACKS.add(
    "an outcome that nothing explains, by method, size and place",
    cases=[
        *[(m, bad, 1) for m in METHODS for bad in (1e15, 1e30, -3e38, 62.0)],
        *[("nsbi", bad, at) for bad in (1e15, 1e30, 62.0, -1e8) for at in (0, 2)],
        *[("alhi", bad, at) for bad in (1e30, 62.0) for at in (0, 2)],
    ],
)
def unexplained(case: tuple[str, float, int]) -> None:
    method, bad, index = case
    c = tell(campaign(method), {index: bad})
    c.update()
    doubted(c, index)
    right(c, 0.25)
    assert c.health == "alarm"
    assert c.ask().index == 3
    c.tell(TRUTH * float(c.pending.action))  # pyright: ignore
    c.update()
    doubted(c, index)
    right(c, 0.25)


@ATTACKS.add(
    "criticize and ask with effects after such an outcome",
    cases=[
        (kind, bad, n)
        for kind in ("model", "draw")
        for bad in (62.0, 1e15, 1e30)
        for n in (0, 1)
    ],
)
def criticized(case: tuple[str, float, int]) -> None:
    kind, bad, num_effects = case
    simulator = MODEL if kind == "model" else noisy
    c = tell(campaign(simulator=simulator, effects=[BIAS][:num_effects]), {1: bad})
    assert c.ask().action.isfinite().all()
    assert "bias" not in c.criticize(evaluate=False).verdict


@ATTACKS.add("all trials are beyond anything simulated", cases=METHODS)
def nothing_explained(method: str) -> None:
    c = tell(campaign(method), {0: 1e6, 1: -1e7, 2: 1e20})
    c.update()
    for index in range(3):
        doubted(c, index)
    assert abs(float(c.belief.mean) - 0.5) < 0.02
    assert c.ask().status == "pending"


@ATTACKS.add("a number beyond all simulations, but near", cases=METHODS)
def near(method: str) -> None:
    c = campaign(method)
    c.tell(2.5, action=[1.0])
    c.update()
    doubted(c, 0)
    assert float(draws(c).median()) > 0.9  # the best that the model has


@ATTACKS.add(
    "one wrong number among several of an outcome", cases=("asbi", "alhi", "constant")
)
def one_number(case: str) -> None:
    def two(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        other = torch.zeros_like(theta) if case == "constant" else noisy(theta, action)
        return torch.cat([noisy(theta, action), other], 1)

    c = campaign("alhi" if case == "alhi" else "asbi", two)
    c.tell([0.62, 1e12], action=[1.0])
    c.tell([1.8, 0.0 if case == "constant" else 1.75], action=[3.0])
    c.update()
    doubted(c, 0)
    right(c)


@ATTACKS.add("a measurement where the simulator has none", cases=METHODS)
def never_measured(method: str) -> None:
    def lost(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.where(action == 1.0, torch.nan, noisy(theta, action))

    c = tell(campaign(method, lost))
    c.update()
    doubted(c, 0)
    right(c)
    c.ask()


@ATTACKS.add(
    "a measurement where the simulator almost never has one", cases=("asbi", "alhi")
)
def seldom_measured(method: str) -> None:
    def lost(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        gone = (action == 1.0) & (theta < 0.99)
        return torch.where(gone, torch.nan, noisy(theta, action))

    c = tell(campaign(method, lost, details=CampaignDetails(num_scored=1_000)))
    c.update()
    assert c.belief.diagnostics.trustworthy is False  # pyright: ignore
    c.ask()


@ATTACKS.add("no measurement where the simulator always has one", cases=METHODS)
def never_invalid(method: str) -> None:
    c = campaign(method)
    c.tell(status="invalid", action=[1.0])
    c.tell(1.8, action=[3.0])
    c.update()
    right(c)
    c.ask()


@ATTACKS.add(
    "a trial told again is as if told right at once",
    cases=[
        *[(m, 1, "updated") for m in METHODS],
        *[("nsbi", i, when) for i in (0, 2) for when in ("updated", "asked", "before")],
        ("asbi", 1, "asked"),
        ("alhi", 0, "asked"),
        ("asbi", 1, "chained"),
    ],
)
def told_again(case: tuple[str, int, str]) -> None:
    method, index, when = case
    changes: dict[str, Any] = {"refine": False} if when == "chained" else {}
    told = tell(campaign(method, **changes))
    wrong = tell(campaign(method, **changes), {index: 62.0})
    if when != "before":
        wrong.update()
    if when == "asked":
        pending = wrong.ask()
    wrong.tell(TOLD[index][1], trial=index)
    same(told, wrong)
    if when == "asked":
        assert wrong.ask() is pending  # the robot may be executing it
        wrong.tell(1.8, action=[3.0])
        told.tell(1.8, action=[3.0])
        same(told, wrong)


@ATTACKS.add(
    "a small mistake corrected: another x, action or status",
    cases=("x", "action", "invalid", "missing"),
)
def small_mistake(what: str) -> None:
    wrong, told = campaign(), campaign()
    first = 0.9 if what == "x" else 0.62
    wrong.tell(first, action=[3.0 if what == "action" else 1.0])
    last: dict[str, Any] = {"action": [1.0], "x": 0.62}
    if what in ("invalid", "missing"):
        last = {"action": [1.0], "status": what}
    told.tell(**last)
    for c in (wrong, told):
        c.tell(1.75, action=[3.0])
    wrong.update()
    wrong.tell(**last, trial=0)
    same(told, wrong)


@ATTACKS.add("a trial withdrawn is as if missing", cases=METHODS)
def withdrawn(method: str) -> None:
    wrong, missing = tell(campaign(method), {1: 1e15}), campaign(method)
    for i, (action, x) in enumerate(TOLD):
        missing.tell(x, action=[action], status="missing" if i == 1 else "ok")
    wrong.update()
    assert wrong.withdraw(1, reason="cm").reason == "cm"
    same(missing, wrong)
    assert wrong.health == "ok"
    assert [t.status for t in wrong.history] == ["ok", "withdrawn", "ok"]


@ATTACKS.add(
    "withdrawn: all, pending, twice, unknown, then told",
    cases=("all", "pending", "twice", "unknown", "told"),
)
def withdrawals(case: str) -> None:
    c = tell(campaign())
    c.update()
    before = draws(c)
    if case == "all":
        for i in range(3):
            c.withdraw(i)
        assert c.update() is PRIOR
        assert c.ask().index == 3
    if case == "pending":
        c.withdraw(c.ask())
        assert c.pending is None
        assert c.ask().index == 4
    if case == "twice":
        c.withdraw(0)
        c.update()
        once = draws(c)
        c.withdraw(0)
        c.update()
        assert torch.equal(once, draws(c))
    if case == "unknown":
        for index in (7, -1, "0", None, 1.0):
            with refused("expected the index of one of 3 trials"):
                c.withdraw(index)  # pyright: ignore
    if case == "told":
        c.withdraw(1)
        c.update()
        c.tell(TOLD[1][1], trial=1)
        c.update()
        assert torch.equal(before, draws(c))


@ATTACKS.add("a trial behind an adoption is corrected", cases=("told", "withdrawn"))
def behind_adoption(case: str) -> None:
    both = []
    for _ in range(2):
        c = campaign()
        for action in (1.0, 3.0, 0.5, 3.0, 1.0):
            c.tell(TRUTH * action + 0.8, action=[action])
        report = c.criticize([BIAS], evaluate=False)
        assert report.verdict == "bias"
        c.adopt(report)
        both.append(c)
    first, second = both
    second.tell(1e9, trial=2)
    second.update()
    doubted(second, 2)
    if case == "withdrawn":
        second.withdraw(2)
        second.update()
        mean = second.belief.mean
        assert bool(((mean - torch.tensor([TRUTH, 0.8])).abs() < 0.3).all())
        return
    second.tell(TRUTH * 0.5 + 0.8, trial=2)
    second.update()
    assert torch.equal(draws(first), draws(second))


NUMBERS: dict[str, Any] = {
    "abc": "abc",
    "list of strings": ["1.5"],
    "None in a list": [None],
    "an object": object(),
    "10**400": 10**400,
    "complex": 1 + 2j,
    "complex tensor": torch.tensor([1j]),
    "1e39": 1e39,
    "float64 array": np.array([-1e300]),
    "float64 tensor": torch.tensor([1e300], dtype=torch.float64),
    "empty": [],
    "no rows": torch.zeros(0, 1),
    "two rows": [[1.0], [2.0]],
    "two numbers": [1.0, 2.0],
    "a date": np.datetime64("2024-01-01"),
    "a dict": {"x": 1.0},
    "bytes": b"1",
    "None": None,
}


@ATTACKS.add("tell what is no outcome", cases=[*NUMBERS])
def bad_outcomes(name: str) -> None:
    c = campaign()
    c.ask()
    with refused("expected", "; got"):
        c.tell(NUMBERS[name])
    assert c.pending is not None
    assert not c.history
    c.tell(0.6 * float(c.pending.action))
    c.update()
    right(c, 0.3)


@ATTACKS.add(
    "tell an action that is none",
    cases=[[np.nan], [np.inf], [-np.inf], [1e39], "abc", [1j], [1.0, 2.0], [], [None]],
)
def bad_actions(action: Any) -> None:
    c = campaign()
    with refused("expected", "action"):
        c.tell(1.0, action=action)
    assert not c.state.trials
    right(tell(c).update() and c)


@ATTACKS.add(
    "an outcome of another type",
    cases=("float", "int", "float16", "float64", "array", "0-d", "list", "inference"),
)
def types(case: str) -> None:
    x = torch.tensor([1.0])
    with torch.inference_mode(case == "inference"):
        told: Any = {
            "float": 1.0,
            "int": 1,
            "float16": x.half(),
            "float64": x.double(),
            "array": x.numpy(),
            "0-d": torch.tensor(1.0),
            "list": [torch.tensor(1.0)],
            "inference": torch.ones(1),
        }[case]
    c, plain = campaign(), campaign()
    c.tell(told, action=[3.0])
    plain.tell(x, action=[3.0])
    same(plain, c)


@ATTACKS.add(
    "the caller changes what was told", cases=("x", "action", "tensor", "robot")
)
def changed_later(case: str) -> None:
    c = campaign()
    if case == "robot":

        def real_system(action: torch.Tensor) -> torch.Tensor:
            action *= 2.0
            return TRUTH * action / 2

        c.run(real_system, num_rounds=2)
        assert all(bool(ACTIONS.contains(t.action)) for t in c.history)
        return
    x, action = np.array([1.75], np.float32), np.array([3.0], np.float32)
    told = torch.from_numpy(x) if case == "tensor" else x
    c.tell(told, action=action)
    x[:], action[:] = 9.0, 7.0
    assert c.history[0].x.tolist() == [1.75]  # pyright: ignore
    assert c.history[0].action.tolist() == [3.0]


@ATTACKS.add(
    "the last outcome told twice", cases=("same", "other", "with action", "missing")
)
def told_twice(case: str) -> None:
    c = campaign()
    action = c.ask().action
    told = c.tell(0.5) if case != "missing" else c.tell(status="missing")
    if case == "same":
        assert c.tell(0.5) is told
    if case == "missing":
        assert c.tell(status="missing") is told
    if case == "other":
        with refused("expected a pending trial"):
            c.tell(0.6)
    if case == "with action":
        assert c.tell(0.5, action=action).index == 1
