"""Parameters that no action tells apart: named where they are, and nowhere else."""

import pytest
import torch

from sbi_active import DiscreteActions
from sbi_active.actions import ActionSpace
from sbi_active.simulation import check_simulator
from tests.identifiability.test_known import CENTERED, POSITIVE, box

SPEEDS = DiscreteActions([0.5, 1.0, 2.0, 3.0], names=["speed"])


def friction(friction, mass, speed):
    return speed**2 / (2 * 9.81 * friction) / (mass + 0.5)


#: Outcome, prior, and the combinations through which the parameters enter it.
OPEN = {
    "product": (lambda a, b, v: v * a * b, [POSITIVE] * 2, ["a * b"]),
    "ratio": (lambda a, b, v: torch.sin(v * a / b), [POSITIVE] * 2, ["a / b"]),
    "shift": (friction, [POSITIVE] * 2, ["a * (b + 0.5)"]),
    "exponential": (
        lambda a, b, v: v * a * torch.exp(-b),
        [POSITIVE, CENTERED],
        ["a * exp(-b)"],
    ),
    "three": (lambda a, b, c, v: v * a * b / c, [POSITIVE] * 3, ["a * b / c"]),
    "two of three": (
        lambda a, b, c, v: torch.cat([v * a * b, v * b * c], 1),
        [POSITIVE] * 3,
        ["a * b", "b * c"],
    ),
    "of five": (
        lambda a, b, c, d, e, v: torch.cat([v * (a + b + c + d), e + 0 * v], 1),
        [CENTERED] * 5,
        ["a + b + c + d"],
    ),
}


def run(fn, bounds, *, actions: ActionSpace = SPEEDS, seed=0):
    def simulator(theta, action):
        x = fn(*theta.split(1, 1), action)
        return x + 0.02 * torch.randn_like(x)

    simulator.parameter_names = [*"abcde"[: len(bounds)]]  # pyright: ignore
    return check_simulator(simulator, box(*bounds), actions, seed=seed)


@pytest.mark.parametrize(("seed", "case"), enumerate(OPEN))
def test_the_combination_is_named(case, seed):
    fn, bounds, known = OPEN[case]
    report = run(fn, bounds, seed=seed)
    (group,) = report.undetermined
    assert [*group.known] == known
    assert group.is_exact
    assert {*group.parameters} <= {*"abcde"}
    assert report.is_ready
    assert f"warning: {group}" in str(report)


def linear(num, seed):
    weights = torch.randn(num, num, generator=torch.Generator().manual_seed(seed))

    def simulator(theta, action):
        x = theta @ weights * (1 + action)
        return x + 0.1 * torch.randn_like(x)

    return simulator


@pytest.mark.parametrize(("seed", "num"), enumerate([2, 5, 20]))
def test_linear_parameters_are_all_determined(num, seed):
    prior = box(*[CENTERED] * num)
    report = check_simulator(linear(num, seed), prior, SPEEDS, seed=seed)
    assert report.undetermined == ()


def test_what_is_below_the_noise_is_hardly_determined_and_not_undetermined():
    """A weak parameter, and a random matrix with a singular value of 1.6e-4."""
    weak = run(lambda a, b, v: v * (a + 1e-4 * b), [CENTERED] * 2)
    matrix = check_simulator(linear(20, 104), box(*[CENTERED] * 20), SPEEDS, seed=4)
    assert weak.undetermined[0].parameters == ("b",)
    for report in (weak, matrix):
        (group,) = report.undetermined
        assert not group.is_exact
        assert "less than a tenth of the noise" in str(group)


DETERMINED = {
    "fall with drag": (
        lambda mu, k, v: torch.log1p(k * v**2 / (9.81 * mu)) / (2 * k),
        [POSITIVE] * 2,
    ),
    "decay": (lambda a, b, v: a * torch.exp(-b * v), [POSITIVE] * 2),
    "mean and spread": (
        lambda a, b, v: a * v + b * torch.randn_like(a),
        [CENTERED, POSITIVE],
    ),
    "one far stronger": (lambda a, b, v: 1e3 * a * v + b, [CENTERED] * 2),
    "too much stronger for float32": (lambda a, b, v: 1e5 * a * v + b, [CENTERED] * 2),
    "weights that may vanish": (lambda a, b, v: a * b + a * v, [CENTERED] * 2),
    "only by failing": (
        lambda a, b, v: torch.where(b > 0.5, torch.nan, a * v),
        [POSITIVE] * 2,
    ),
}


@pytest.mark.parametrize("case", DETERMINED)
def test_nothing_is_said_of_parameters_that_are_determined(case):
    assert run(*DETERMINED[case]).undetermined == ()


def test_an_action_that_tells_them_apart_is_all_it_takes():
    def fn(a, b, v):
        return torch.where(v > 2.5, a * v, a * b * v)

    assert run(fn, [POSITIVE] * 2).undetermined == ()
    (group,) = run(fn, [POSITIVE] * 2, actions=DiscreteActions([1.0, 2.0])).undetermined
    assert group.known == ("a * b",)
