"""What beliefs know of parameters together, and what no action tells apart."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution, MultivariateNormal

from sbi_active import DiscreteActions
from sbi_active.identifiability.formula import Combination, Term
from sbi_active.identifiability.known import combinations_of
from sbi_active.simulation import check_simulator

POSITIVE, CENTERED = (0.2, 1.0), (-1.0, 1.0)


class Draws(Distribution):
    """An exact posterior, as resampled draws of the prior."""

    def __init__(self, draws):
        super().__init__(event_shape=draws.shape[1:], validate_args=False)
        self.draws = draws

    def sample(self, sample_shape=torch.Size()):  # noqa: B008
        shape = torch.Size(sample_shape)
        return self.draws[torch.randint(len(self.draws), shape)]


def box(*bounds):
    low, high = zip(*bounds, strict=True)
    return BoxUniform(torch.tensor(low), torch.tensor(high))


def posterior(fn, prior, truth, *, sd=0.01, seed=0):
    """Importance resampling of 300,000 draws of the prior, under Gaussian noise."""
    torch.manual_seed(seed)
    theta = prior.sample((300_000,)).double()
    x = fn(*torch.tensor([truth]).double().split(1, 1))
    x = x + sd * torch.randn_like(x)
    miss = (fn(*theta.split(1, 1)) - x) / sd
    weight = (-0.5 * miss.square().sum(1)).softmax(0)
    assert 1 / weight.square().sum() > 150
    return Draws(theta[torch.multinomial(weight, 8_000, replacement=True)].float())


#: Outcome, prior, truth, what is known of it, what is not.
OPEN = {
    "product": (lambda a, b: a * b, [POSITIVE] * 2, [0.5, 0.7], ["a * b"], ["a / b"]),
    "sum": (lambda a, b: a + b, [CENTERED] * 2, [0.5, -0.2], ["a + b"], ["a - b"]),
    "shift": (
        lambda a, b: a * (b + 0.5),
        [POSITIVE] * 2,
        [0.5, 0.7],
        ["a * (b + 0.5)"],
        ["a / (b + 0.5)"],
    ),
    "no effect": (lambda a, b: a + 0 * b, [CENTERED] * 2, [0.5, -0.2], [], ["b"]),
    "three": (
        lambda a, b, c: a * b / c,
        [(0.5, 2.0)] * 3,
        [1.2, 1.0, 0.8],
        ["a * b / c"],
        ["a, b, c, each by itself"],
    ),
    "beside a known one": (
        lambda a, b, c: torch.cat([a * b, c], 1),
        [POSITIVE, POSITIVE, CENTERED],
        [0.5, 0.6, -0.2],
        ["a * b"],
        ["a / b"],
    ),
}


@pytest.mark.parametrize(("seed", "case"), enumerate(OPEN))
def test_the_combination_is_named_with_its_interval(case, seed):
    fn, bounds, truth, known, unknown = OPEN[case]
    prior, names = box(*bounds), [*"abc"]
    belief = posterior(fn, prior, truth, seed=seed)
    found = combinations_of(belief, prior, names, seed=seed)
    assert [c.text for c in found.known] == known
    assert [c.text for c in found.unknown] == unknown
    for c in found.known:
        value = float(fn(*torch.tensor([truth]).split(1, 1)).flatten()[0])
        assert c.low < c.value < c.high
        assert abs(c.value - value) < 2.5 * (c.high - c.low)  # 8 standard deviations
        assert f"{c.text} = " in str(found)
    # A little of the prior does not hide it.
    mixed = torch.cat([belief.draws, prior.sample((len(belief.draws) // 200,))])
    again = combinations_of(Draws(mixed), prior, names, seed=seed)
    assert [c.text for c in again.known] == known


def linear_posterior(num, num_trials, seed, sd=0.05):
    rng = torch.Generator().manual_seed(seed)
    design = torch.randn(num_trials, num, generator=rng, dtype=torch.float64)
    covariance = torch.linalg.inv(torch.eye(num) + design.T @ design / sd**2)
    covariance = 0.5 * (covariance + covariance.T).float()
    prior = MultivariateNormal(torch.zeros(num), torch.eye(num))
    belief = MultivariateNormal(torch.zeros(num), covariance + 1e-8 * torch.eye(num))
    return belief, prior, covariance


SPEEDS = torch.tensor([0.5, 1.0, 4.0])
NONLINEAR = {
    "drag": lambda a, b: torch.log1p(b * SPEEDS**2 / a) / (2 * b),
    "decay": lambda a, b: torch.cat([a * torch.exp(-b * t) for t in (0.1, 3.0)], 1),
    "two modes": lambda a, b: torch.cat([(a - 0.6) ** 2, b], 1),
}


@pytest.mark.parametrize(("seed", "case"), enumerate(NONLINEAR))
def test_nor_of_others_that_are(case, seed):
    """Two narrow modes as far apart as the prior is wide are not unknown."""
    prior = box(POSITIVE, POSITIVE)
    belief = posterior(NONLINEAR[case], prior, [0.3, 0.7], sd=0.02, seed=seed)
    assert not combinations_of(belief, prior, seed=seed)


@pytest.mark.parametrize(
    ("num", "share"), [(2, 0.5), (2, 2.0), (20, 0.1), (20, 0.5), (20, 1.0), (20, 2.0)]
)
def test_what_is_said_after_few_trials_is_true(num, share):
    """Compared with the exact standard deviations."""
    for seed in range(4):
        num_trials = max(int(share * num), 1)
        belief, prior, covariance = linear_posterior(num, num_trials, seed)
        found = combinations_of(belief, prior, seed=seed)
        if share == 2.0:  # all parameters are known
            assert not found
            continue
        deviation = covariance.diagonal().sqrt()
        assert all(c.width < 0.11 * float(deviation.max()) for c in found.known)
        for c in found.unknown:
            if c.text.startswith("theta") and " " not in c.text:
                i = int(c.text.removeprefix("theta_")) - 1
                assert float(deviation[i]) == pytest.approx(c.width, rel=0.1)
                assert float(deviation[i]) > 0.4


# Formulas in words, and what they compute


NAMES = [*"abcdef"]


def product(*weights, shifts=()):
    shifts = dict(shifts)
    shift = [shifts.get(i, 0.0) for i in range(len(weights))]
    terms = zip(range(len(weights)), weights, shift, strict=True)
    return Combination(tuple(Term(i, w, log=True, shift=s) for i, w, s in terms))


#: Combinations, and how they read.
FORMULAS = [
    (product(2, -0.5), "a^2 / b^0.5"),
    (product(-1, 1), "1 / a * b"),
    (product(1, -1, shifts={0: -0.25}), "(a - 0.25) / b"),
    (Combination((Term(0), Term(1, -0.8))), "a - 0.8 * b"),
    (Combination((Term(0, -1.0), Term(1))), "-a + b"),
    (Combination((Term(0, log=True), Term(1, -2.0))), "a * exp(-2 * b)"),
    (Combination((Term(0), Term(1, log=True))), "b * exp(a)"),
    (product(1, 1, 1, 1, 1), "a * b * c * d * ..."),
]


@pytest.mark.parametrize(("combination", "text"), FORMULAS)
def test_formulas_read_as_they_compute(combination, text):
    assert combination.text(NAMES) == text
    if "..." in text:
        return
    theta = np.random.default_rng(0).uniform(0.5, 2.0, (7, 2))
    scope = {"a": theta[:, 0], "b": theta[:, 1], "exp": np.exp}
    value = eval(text.replace("^", "**"), scope)
    assert combination.value(theta) == pytest.approx(value)


# Parameters that no action tells apart: named where they are, and nowhere else


PUSHES = DiscreteActions([0.5, 1.0, 2.0, 3.0], names=["speed"])


def friction(friction, mass, speed):
    return speed**2 / (2 * 9.81 * friction) / (mass + 0.5)


def damped(size, damping, speed):
    return speed * size * torch.exp(-damping)


def drag(friction, drag, speed):
    return torch.log1p(drag * speed**2 / (9.81 * friction)) / (2 * drag)


def spread(mean, sd, speed):
    return mean * speed + sd * torch.randn_like(mean)


def failing(mean, limit, speed):
    return torch.where(limit > 0.5, torch.nan, mean * speed)


#: Outcome, prior, and the combinations through which the parameters enter it.
UNTOLD = {
    "product": (lambda a, b, v: v * a * b, [POSITIVE] * 2, ["a * b"]),
    "ratio": (lambda a, b, v: torch.sin(v * a / b), [POSITIVE] * 2, ["a / b"]),
    "shift": (friction, [POSITIVE] * 2, ["a * (b + 0.5)"]),
    "exponential": (damped, [POSITIVE, CENTERED], ["a * exp(-b)"]),
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


def run(fn, bounds, *, actions=PUSHES, seed=0):
    def simulator(theta, action):
        x = fn(*theta.split(1, 1), action)
        return x + 0.02 * torch.randn_like(x)

    simulator.parameter_names = [*"abcde"[: len(bounds)]]  # pyright: ignore
    return check_simulator(simulator, box(*bounds), actions, seed=seed)


@pytest.mark.parametrize(("seed", "case"), enumerate(UNTOLD))
def test_the_combination_is_named(case, seed):
    fn, bounds, known = UNTOLD[case]
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
    report = check_simulator(linear(num, seed), prior, PUSHES, seed=seed)
    assert report.undetermined == ()


def test_what_is_below_the_noise_is_hardly_determined_and_not_undetermined():
    """A weak parameter, and a random matrix with a singular value of 1.6e-4."""
    weak = run(lambda a, b, v: v * (a + 1e-4 * b), [CENTERED] * 2)
    matrix = check_simulator(linear(20, 104), box(*[CENTERED] * 20), PUSHES, seed=4)
    assert weak.undetermined[0].parameters == ("b",)
    for report in (weak, matrix):
        (group,) = report.undetermined
        assert not group.is_exact
        assert "less than a tenth of the noise" in str(group)


DETERMINED = {
    "fall with drag": (drag, [POSITIVE] * 2),
    "decay": (lambda a, b, v: a * torch.exp(-b * v), [POSITIVE] * 2),
    "mean and spread": (spread, [CENTERED, POSITIVE]),
    "one far stronger": (lambda a, b, v: 1e3 * a * v + b, [CENTERED] * 2),
    "too much stronger for float32": (lambda a, b, v: 1e5 * a * v + b, [CENTERED] * 2),
    "weights that may vanish": (lambda a, b, v: a * b + a * v, [CENTERED] * 2),
    "only by failing": (failing, [POSITIVE] * 2),
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
