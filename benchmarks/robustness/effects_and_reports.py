"""Attacks on declared effects, on trials as they come, and on what a report claims."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch.distributions import (
    Distribution,
    HalfNormal,
    LogNormal,
    Normal,
    TransformedDistribution,
    Uniform,
)
from torch.distributions.transforms import PowerTransform

from benchmarks.robustness.attacks import Attacks
from sbi_active import Campaign, DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials, generic_effects

ATTACKS = Attacks()

NAN, INF = float("nan"), float("inf")
PRIOR = BoxUniform(-3 * torch.ones(1), 3 * torch.ones(1))
ACTIONS = DiscreteActions([1.0, 1.5, 2.0, 3.0], names=["speed"], units=["m/s"])
SPEED = torch.tensor([1.0, 2.0, 3.0, 2.0, 1.5])
ERRORS = 0.1 * torch.tensor([0.3, -1.2, 0.8, 0.1, -0.4])
MODEL = SimulatorModel(lambda theta, xi: theta * xi, noise=GaussianNoise(0.1))


def _effect(name: Any = "bias", **changes: Any) -> Effect:
    parts = {
        "hook": "observation",
        "prior": Normal(0.0, 1.0),
        "null": 0.0,
        "apply": lambda value, phi, action, context: value + phi,
    }
    return Effect(name, **(parts | changes))


def _loop(*effects: Effect, bias: float = 0.0, **options: Any) -> Criticism:
    trials = Trials(SPEED, 0.7 * SPEED + bias + ERRORS)
    return Criticism(MODEL, PRIOR, trials, effects=effects, **options)


def _refused(attempt: Callable[[], Any], *words: str) -> None:
    """Raise unless the attempt ends in a ValueError with these words."""
    text = ""
    try:
        attempt()
    except ValueError as error:
        text = str(error)
    assert text, "accepted"
    missing = [word for word in words if word not in text]
    assert not missing, f"{missing} not in: {text}"


NULLS = {
    "nan": NAN,
    "tensor of nan": torch.tensor([NAN]),
    "text": "0",
    "none": None,
    "two for one": [0.0, 0.0],
    "complex": 1j,
}


@ATTACKS.add("a null that is none", cases=(*NULLS,))
def null_is_none(case: str) -> None:
    _refused(lambda: _effect(null=NULLS[case]), "expected a null", "'bias'")


EXCLUDED: dict[str, tuple[Distribution, Any]] = {
    "uniform above": (Uniform(1.0, 2.0), 0.0),
    "uniform below": (Uniform(-2.0, -1.0), 0.0),
    "half-normal, negative null": (HalfNormal(1.0), -0.5),
    "log-normal, negative null": (LogNormal(0.0, 1.0), -1.0),
    "second of two": (Uniform(torch.zeros(2), torch.ones(2)), torch.tensor([0.0, 2.0])),
    "box": (BoxUniform(torch.ones(1), 2 * torch.ones(1)), 0.0),
}


def _away_from(null: Any) -> Callable[..., Any]:
    def apply(value: Any, phi: Any, action: Any, context: Any) -> Any:
        return value + (phi - torch.as_tensor(null)).sum(-1, keepdim=True)

    return apply


@ATTACKS.add("a prior that excludes its null", cases=(*EXCLUDED,))
def prior_excludes_null(case: str) -> None:
    prior, null = EXCLUDED[case]
    made = _effect(prior=prior, null=null, apply=_away_from(null))
    _refused(lambda: _loop(made), "allows its null", "'bias'")
    _refused(lambda: Campaign(MODEL, PRIOR, ACTIONS, effects=[made]), "its null")


ALLOWED: dict[str, tuple[Distribution, Any]] = {
    "half-normal": (HalfNormal(1.0), 0.0),
    "uniform to 1": (Uniform(0.0, 1.0), 0.0),
    "uniform from -1": (Uniform(-1.0, 0.0), 0.0),
    "log-normal": (LogNormal(0.0, 1.0), 0.0),
}


@ATTACKS.add("a null on the edge of the prior's support", cases=(*ALLOWED,))
def null_on_the_edge(case: str) -> None:
    prior, null = ALLOWED[case]
    sign = -1.0 if case == "uniform from -1" else 1.0
    probabilities = _loop(_effect(prior=prior, null=null), bias=0.9 * sign).trace()
    assert probabilities.verdict == "bias", probabilities.probabilities


PARTS = {
    "name 3": {"name": 3},
    "no name": {"name": ""},
    "name with +": {"name": "a + b"},
    "units 3": {"units": 3},
    "units none": {"units": None},
    "family 3": {"family": 3},
    "describe bytes": {"describe": b"drag"},
    "apply none": {"apply": None},
    "prior a number": {"prior": 1.0},
    "prior none": {"prior": None},
    "prior draws nan": {
        "prior": TransformedDistribution(
            Normal(0.0, 1.0), PowerTransform(torch.tensor(0.5))
        )
    },
    "unknown hook": {"hook": "sensor"},
    "unknown scope": {"scope": "row"},
}


@ATTACKS.add("a part of an effect of another kind", cases=(*PARTS,))
def part_of_another_kind(case: str) -> None:
    _refused(lambda: _effect(**PARTS[case]), "expected")


NAMES = {
    "two of one name": ("bias", "bias"),
    "a parameter's": ("theta_1",),
    "none": ("none",),
    "unexplained": ("unexplained",),
    "scatter": ("scatter",),
}


@ATTACKS.add("a name that is taken", cases=(*NAMES,))
def name_is_taken(case: str) -> None:
    _refused(lambda: _loop(*map(_effect, NAMES[case])), "expected effects")


RETURNS: dict[str, tuple[str, Callable[..., Any]]] = {
    "nothing": ("observation", lambda v, phi, a, c: None),
    "a number": ("observation", lambda v, phi, a, c: 0.0),
    "phi along the wrong axis": ("observation", lambda v, phi, a, c: v + phi[:, 0]),
    "truth values": ("observation", lambda v, phi, a, c: v + phi > 0),
    "complex numbers": ("observation", lambda v, phi, a, c: v + phi + 0j),
    "a flat action": ("action", lambda v, phi, a, c: (v + phi)[:, 0]),
    "another parameter more": ("parameter", lambda v, phi, a, c: torch.cat([v, v], 1)),
    "one row of noise": ("noise", lambda v, phi, a, c: v[:1]),
    "no keywords": ("dynamics", lambda v, phi, a, c: None),
}


@ATTACKS.add("apply returns something else", cases=(*RETURNS,))
def apply_returns_something_else(case: str) -> None:
    hook, apply = RETURNS[case]
    _refused(lambda: _loop(_effect(hook=hook, apply=apply)), "'bias'", "return")


def _times_too_much(sd: Any, phi: Any, action: Any, context: Any) -> Any:
    sd *= 1.5 + phi
    return sd


@ATTACKS.add("noise that is negative, or wrong at the null in place", cases=(1, 2))
def noise_is_wrong(case: int) -> None:
    if case == 1:
        made = _effect(
            hook="noise", prior=Normal(0.0, 2.0), apply=lambda sd, phi, a, c: sd + phi
        )
        return _refused(lambda: _loop(made), "keep the noise positive")
    made = _effect(hook="noise", prior=HalfNormal(1.0), apply=_times_too_much)
    return _refused(lambda: _loop(made), "vanish at its null", "0.5")


def _in_place(value: Any, phi: Any, action: Any, context: Any) -> Any:
    value += phi
    phi.zero_()
    action.zero_()
    return value


KEPT = torch.zeros(1_000_000, 1).double()


def _from_a_buffer(value: Any, phi: Any, action: Any, context: Any) -> Any:
    rows = KEPT[: len(value)].to(value.dtype)
    rows[:] = value + phi
    return rows[: len(value)]


CHANGED = {
    "in place": _in_place,
    "a view of its own": _from_a_buffer,
    "numpy": lambda v, phi, a, c: v.numpy() + phi.numpy(),
    "numpy, double": lambda v, phi, a, c: v.numpy() + phi.numpy().astype(float),
}


@ATTACKS.add(
    "apply on its own terms: the same probabilities",
    cases=[f"{hook}, {how}" for hook in ("action", "observation") for how in CHANGED],
)
def apply_on_its_own_terms(case: str) -> None:
    hook, how = case.split(", ", 1)
    second = _effect("slope", apply=lambda x, phi, a, c: x + 0.1 * phi * a)
    right = _loop(_effect(hook=hook), second, bias=0.5).trace()
    own = _loop(_effect(hook=hook, apply=CHANGED[how]), second, bias=0.5).trace()
    for name, p in right.probabilities.items():
        assert abs(p - own.probabilities[name]) < 1e-9, (name, p)


TRIALS: dict[str, dict[str, Any]] = {
    "complex x": {"x": np.ones((2, 2)) + 1j},
    "complex tensor": {"x": torch.ones(2, 2) + 1j},
    "text": {"x": ["a", "b"]},
    "dates": {"x": np.array(["2020", "2021"], dtype="datetime64")},
    "x of no numbers": {"x": np.ones((2, 0))},
    "no x at all": {"x": [[NAN, NAN], [NAN, NAN]]},
    "another number of x": {"x": [[1.0, 2.0]]},
    "action nan": {"action": [1.0, NAN]},
    "action inf": {"action": [1.0, INF]},
    "action of no entry": {"action": np.ones((2, 0))},
    "action of three axes": {"action": np.ones((2, 1, 1))},
    "action of text": {"action": ["slow", "fast"]},
    "index nan": {"index": [0.0, NAN]},
    "index too long": {"index": [0, 1, 2]},
    "times backward": {"sample_times": [1.0, 0.0]},
    "times twice": {"sample_times": [0.0, 0.0]},
    "times nan": {"sample_times": [0.0, NAN]},
    "times inf": {"sample_times": [0.0, INF]},
    "times too many": {"sample_times": [0.0, 1.0, 2.0]},
    "repeat of none such": {"repeat_of": [-1, 7]},
    "repeat of a half": {"repeat_of": [-1, 0.5]},
    "repeat of nan": {"repeat_of": [-1, NAN]},
    "repeats in a circle": {"repeat_of": [1, 0]},
    "mask of bytes": {"mask": [[255, 255], [255, 0]]},
    "mask of another shape": {"mask": [1, 0]},
    "role as text": {"role": "fit"},
    "role unknown": {"role": ["fit", "test"]},
    "too few labels": {"channel_labels": ["a"]},
    "labels as text": {"channel_labels": "ab"},
    "action labels": {"action_labels": ["a", "b"]},
}


@ATTACKS.add("trials that are none", cases=(*TRIALS,))
def trials_that_are_none(case: str) -> None:
    parts = {"action": [1.0, 2.0], "x": [[1.0, 2.0], [3.0, 4.0]]} | TRIALS[case]
    _refused(lambda: Trials(**parts), "expected")


GIVEN: dict[str, Callable[[Any], Any]] = {
    "numpy": np.array,
    "torch double": lambda rows: torch.tensor(rows).double(),
    "numpy slice": lambda rows: np.array([*rows, *rows])[: len(rows)],
}


@ATTACKS.add("arrays that change after they were given", cases=(*GIVEN,))
def arrays_change(case: str) -> None:
    action, x = (GIVEN[case](rows) for rows in ([1.0, 2.0, 3.0], [[1.0], [2.0], [3.0]]))
    trials = Trials(action, x)
    action[:], x[:] = 99.0, 99.0
    assert trials.action[:, 0].tolist() == [1.0, 2.0, 3.0]
    assert trials.x[:, 0].tolist() == [1.0, 2.0, 3.0]


NUMBERS: dict[str, Any] = {
    "gradient": torch.ones(2, 1, requires_grad=True),
    "bfloat16": torch.ones(2, 1, dtype=torch.bfloat16),
    "integers": [[1], [1]],
    "objects": np.array([[1], [1]], dtype=object),
    "fortran order": np.ones((2, 1), order="F"),
    "not writable": np.broadcast_to(np.ones(1), (2, 1)),
}


@ATTACKS.add("numbers of another type", cases=(*NUMBERS,))
def numbers_of_another_type(case: str) -> None:
    assert Trials([1.0, 2.0], NUMBERS[case]).x.tolist() == [[1.0], [1.0]]


@ATTACKS.add("what was not measured", cases=("masked array", "inf", "none", "padding"))
def not_measured(case: str) -> None:
    x = {
        "masked array": np.ma.masked_array(
            [[1.0, 9.0], [2.0, 3.0]], np.array([[0, 1], [0, 0]])
        ),
        "inf": [[1.0, INF], [2.0, 3.0]],
        "none": np.array([[1.0, None], [2.0, 3.0]], dtype=object),
        "padding": [[1.0], [2.0, 3.0]],
    }[case]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        trials = Trials([1.0, 2.0], x)
    assert trials.mask.tolist() == [[True, False], [True, True]]
    assert (case == "inf") == any("taken as not measured" in str(w) for w in said)


def _pendulum(theta: Any, action: Any, magnet: float = 0.0) -> Any:
    """Angles of a pendulum let go at the action, midpoint rule."""
    length, damping = theta.T
    q, v = action[:, 0], torch.zeros(len(action)).to(action)

    def force(q: Any, v: Any) -> Any:
        return -9.81 / length * torch.sin(q) - damping * v - magnet * torch.sin(2 * q)

    x = []
    for k in range(24):
        half = q + 0.04 * v, v + 0.04 * force(q, v)
        q, v = q + 0.08 * half[1], v + 0.08 * force(*half)
        x += [q] if (k + 1) % 3 == 0 else []
    return torch.stack(x, 1)


@ATTACKS.add("a magnet that nobody declared", cases=(1, 2, 3), seconds=300)
def undeclared_magnet(case: int) -> None:
    """Whatever it is taken for, the report says on what condition, and no "stop"."""
    torch.set_num_threads(1)  # those of the process that forked are not here
    actions = DiscreteActions(
        torch.linspace(0.2, 1.2, 11).double(), names=["angle"], units=["rad"]
    )
    model = SimulatorModel(
        _pendulum, noise=GaussianNoise(0.01), parameter_names=["length", "damping"]
    )
    prior = BoxUniform(torch.tensor([0.3, 0.0]), torch.tensor([2.0, 1.0]))
    generator = torch.Generator().manual_seed(case)
    action = actions.values[torch.randperm(11, generator=generator)[:8]]
    theta = torch.tensor([[1.0, 0.2]]).double().expand(8, 2)
    x = _pendulum(theta, action, magnet=1.0)
    x = x + 0.01 * torch.randn(x.shape, generator=generator)
    effects = [e for e in generic_effects(model, actions) if e.name.endswith(" gain")]
    report = Criticism(
        model, prior, Trials(action, x), effects=effects, actions=actions
    ).report(evaluate=False)
    assert report.verdict == "action gain + sensor gain", report.verdict
    text = " ".join(str(report).split())
    assert "stop" not in str(report).lower()
    assert "P holds among the declared effects alone" in text
    assert "Against the bare fit the verdict moves length by" in text
    assert "No other action was tried than these 8" in text
    inside, beyond = report.severe_tests
    assert inside.is_permitted
    assert float(beyond.action[0]) > 1.2
    assert beyond.difference > inside.difference


@ATTACKS.add("a report without a named effect claims none", cases=("none", "only bias"))
def report_of_none(case: str) -> None:
    made = _loop(_effect(), actions=ACTIONS, bias=0.9 * (case == "only bias"))
    report = made.report(evaluate=False)
    assert report.verdict == ("none" if case == "none" else "bias"), report.verdict
    text = " ".join(str(report).split())
    assert ("P holds among the declared effects" in text) == (case != "none")
    if case != "none":
        assert "Stop" not in text
        assert len(report.severe_tests) == 2


@ATTACKS.add("a report where no action is known to be permitted")
def report_without_actions(case: str) -> None:
    report = _loop(_effect(), bias=0.9).report(evaluate=False)
    assert report.next_action is None
    assert report.severe_tests == ()
    assert "No other action was tried" in " ".join(str(report).split())


@ATTACKS.add("a simulator that fails beyond the permitted range")
def fails_beyond(case: str) -> None:
    def forward(theta: Any, xi: Any) -> Any:
        if bool((xi < 1).any() or (xi > 3).any()):
            raise ValueError("the gripper pushes at 1 to 3 m/s")
        return theta * xi

    model = SimulatorModel(forward, noise=GaussianNoise(0.1))
    trials = Trials(SPEED, 0.7 * SPEED + 0.9 + ERRORS)
    report = Criticism(
        model, PRIOR, trials, effects=[_effect()], actions=ACTIONS
    ).report(evaluate=False)
    assert [test.is_permitted for test in report.severe_tests] == [True]
    assert "beyond the permitted range" not in " ".join(str(report).split())
