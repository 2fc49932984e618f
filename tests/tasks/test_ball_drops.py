"""Falling balls: the fall, what it may lack, and the measured drops."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from benchmarks.__main__ import main as run
from benchmarks.measured import ball_drops as benchmark
from benchmarks.measured.ball_tables import tables
from benchmarks.measured.fall_least_squares import forecast_error, second_drop_error
from sbi_active import AutocorrelatedNoise
from sbi_active.criticism import AugmentedSimulator, Criticism
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.ball_drops import (  # pyright: ignore
    Drop,
    fall,
    make_effects,
    make_prior,
    make_simulator,
    read_drops,
    trials_of,
)
from sbi_active.tasks.product import Product  # pyright: ignore

DATA = Path(__file__).parents[3] / "shared" / "data" / "ball_drops"
measured = pytest.mark.skipif(not DATA.is_dir(), reason=f"no data in {DATA}")
G, TIMES = 9.81, torch.linspace(0, 4, 61).double()
LEVEL = torch.zeros(1, 2).double()


def drop(strength, exponent=1.0, *, start=0.1, sd=0.0, seed=0, number=1) -> Drop:
    """Return a fall with drag, with independent errors."""
    times = torch.arange(52).double() / 15
    drag = torch.tensor([strength]).double()
    args = {"times": times[None], "start": start, "drag": drag, "exponent": exponent}
    heights = fall(LEVEL, torch.zeros(1, 1), **args)[0].numpy()
    noise = np.random.default_rng(seed).normal(size=52) * sd
    return Drop("ball", number, times.numpy(), heights + noise, 0.1)


@pytest.mark.parametrize("strength", [0.5, 3.0])
@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_the_fall_with_drag_is_the_closed_form(strength, exponent):
    s = (TIMES - 0.2).clamp(min=0)
    if exponent == 1.0:
        c = strength / 10
        way = G / c * s - G / c**2 * (1 - torch.exp(-c * s))
    else:
        k = strength / 100
        way = torch.log(torch.cosh((G * k) ** 0.5 * s)) / k
    drag = torch.tensor([strength]).double()
    args = {"times": TIMES[None], "start": 0.2, "drag": drag, "exponent": exponent}
    x = fall(LEVEL, torch.zeros(1, 1), **args)[0]
    assert float((x - (47 - way)).abs().max()) < 1e-4


def test_without_air_the_fall_is_a_parabola_and_the_camera_bends_it():
    h = 47 - 0.5 * G * TIMES**2
    theta = torch.tensor([[0.1, 0.5]]).double()
    x = fall(theta, torch.zeros(1, 1), times=TIMES[None])[0]
    expected = 47 + 1.1 * (h - 47) + 0.5 * ((h - 29) / 18) ** 2
    torch.testing.assert_close(x, expected)


def test_each_row_is_its_own_whatever_stands_beside_it():
    theta = LEVEL.repeat(3, 1)
    times = torch.stack([TIMES, TIMES / 2, TIMES + 0.3])
    drag, exponent = torch.tensor([[1.0, 2.0, 5.0], [0.5, 1.3, 2.5]]).double()
    x = fall(theta, theta, times=times, drag=drag, exponent=exponent)
    one = fall(LEVEL, LEVEL, times=times[1:2], drag=drag[1:2], exponent=exponent[1:2])
    torch.testing.assert_close(x[1:2], one)


def test_every_effect_vanishes_at_its_null_and_moves_x_elsewhere():
    task = get_task("ball_drops")
    theta, action = task.prior.sample((16,)), task.actions.values[:1].repeat(16, 1)
    model = AugmentedSimulator(task.simulator, task.effects(), check=(theta, action))
    bare = model.evaluate(theta, {}, action)
    for effect in task.effects():
        if effect.name == "wind":  # which the drag alone sees
            continue
        phi = effect.sample(16).to(theta.dtype)
        change = (model.evaluate(theta, {effect.name: phi}, action) - bare).abs()
        assert float(change.max()) > 0.01, effect.name


def test_the_drag_sees_the_air_that_moves():
    drag, wind = torch.tensor([2.0, 2.0, 2.0]).double(), torch.tensor([0.0, 1.0, -1.0])
    theta = LEVEL.repeat(3, 1)
    still, up, down = fall(
        theta, theta, times=TIMES[None], drag=drag, wind=wind.double()
    )
    assert (up[5:] > still[5:]).all()  # rising air holds the ball longer
    assert (down[5:] < still[5:]).all()
    bare = fall(theta, theta, times=TIMES[None], wind=wind.double())
    assert torch.equal(bare[0], bare[1])


def test_the_task_is_a_real_system():
    task = get_task("ball_drops", theta_true=(0.01, 0.1))
    x = torch.stack(
        [task.real_system(task.actions.values[0], seed=s) for s in range(99)]
    )
    middle = task.simulator.mean(task.theta_true[None], task.actions.values[:1])[0]
    # Its noise has a standard deviation of at most .2 m.
    assert float((x.mean(0) - middle).abs().max()) < 5 * 0.2 / math.sqrt(99)
    with pytest.raises(ValueError, match="theta_true of two finite numbers; got"):
        get_task("ball_drops", theta_true=(0.1,))


def test_the_noise_is_log_uniform_in_size_and_correlation_time():
    bounds = torch.tensor([[0.02, 0.2], [0.015, 7.5]]).double()
    noise = AutocorrelatedNoise.unknown(
        sd=(0.02, 0.2), correlation_time=(0.015, 7.5), num_sds=16, num_times=10
    )
    assert noise.posterior is not None
    low, high = bounds.log().T
    share = (noise.posterior.sample((2_000,)).log() - low) / (high - low)
    assert min(kstest(column.numpy(), "uniform").pvalue for column in share.T) > 1e-3


def test_a_product_has_the_density_of_its_parts():
    parts = [
        torch.distributions.HalfNormal(torch.tensor([3.0])),
        torch.distributions.Uniform(torch.tensor([0.5]), torch.tensor([2.5])),
    ]
    both = Product(parts)
    draws = both.sample((500,))
    assert bool(both.support.check(draws).all())
    expected = parts[0].log_prob(draws[:, 0]) + math.log(0.5)
    torch.testing.assert_close(both.log_prob(draws), expected)
    assert not bool(both.support.check(torch.tensor([1.0, 3.0])))


def test_a_cut_drop_is_masked_from_there_on():
    pair = [drop(1.0), drop(1.0, number=2)]
    trials = trials_of(pair, until={1: 0.8})
    assert trials.x.shape == (2, 52)
    assert trials.mask.sum(1).tolist() == [52, 13]
    assert trials.action.tolist() == [[0.1], [0.1]]


def test_data_that_are_not_there(capsys):
    with pytest.raises(FileNotFoundError, match="got no drops.csv there; give"):
        read_drops("nowhere")
    assert run(["measured.ball_drops", "--data", "nowhere"]) == 2
    printed = capsys.readouterr().err
    assert "expected the measured drops in nowhere" in printed
    assert "--data DIR" in printed


def test_data_without_a_column():
    Path("drops.csv").write_text("ball,drop,time_s\na,1,0\n")
    Path("balls.csv").write_text("ball,mass_kg,circumference_m\na,1,1\n")
    with pytest.raises(ValueError, match="got none named height_m; name them so"):
        read_drops(".")


@pytest.mark.parametrize("kind", ["linear drag", "quadratic drag"])
def test_least_squares_given_the_effect_finds_it(kind):
    exponent = 1.0 if kind == "linear drag" else 2.0
    pair = drop(3.0, exponent), drop(3.0, exponent, start=0.2, number=2)
    assert second_drop_error(*pair, kind) < 1e-3
    assert forecast_error(*pair, kind, until=0.8) < 1e-2
    assert second_drop_error(*pair, "gravity alone") > 0.5


@measured
@pytest.mark.parametrize(
    ("kind", "second", "rest"),
    [("gravity alone", 1.64, 7.37), ("linear drag", 0.28, 0.84)],
)
def test_least_squares_on_the_measured_drops(kind, second, rest):
    """Root mean squares over 22 folds, as published with the data."""
    drops = read_drops(DATA)
    assert (len(drops), sum(len(d.times) for d in drops)) == (22, 1064)
    pairs = [
        p
        for a, b in zip(drops[::2], drops[1::2], strict=True)
        for p in ((a, b), (b, a))
    ]
    one = [second_drop_error(*pair, kind) for pair in pairs]
    two = [forecast_error(*pair, kind, until=0.8) for pair in pairs]
    assert np.sqrt(np.mean(np.square(one))) == pytest.approx(second, abs=0.02)
    assert np.sqrt(np.mean(np.square(two))) == pytest.approx(rest, abs=0.02)


def row(ball="a", **changes):
    """Return a made-up row of both kinds."""
    errors = {
        f"{what} {name}": 1.0
        for what in ("second drop", "forecast")
        for name in ("before", "after", *benchmark.KINDS)
    }
    found = {"verdict": "linear drag", "probability_of_drag": 0.8, "alarm": True}
    found |= {"log_bayes_factor": 9.0, "credible_set": ["linear drag", "unexplained"]}
    found |= {"exponent": [0.6, 1.0, 1.4], "linear_over_quadratic": 2.0, "tested": 1}
    return {"ball": ball, **errors, "coverage before": 0.5, "coverage after": 0.9} | {
        **found,
        **changes,
    }


def test_tables_add_squares_up_and_name_the_family():
    rows = [row("a", **{"forecast after": 0.3}), row("b", **{"forecast after": 0.4})]
    rows.append(row("c", verdict="none", probability_of_drag=0.1, alarm=False))
    text = tables(rows)
    assert (
        "| a | drag-like | 0.80 | 9.0 | linear drag, unexplained | 1.00 (0.60" in text
    )
    assert "| c | none | 0.10 |" in text
    assert f"{math.sqrt((0.09 + 0.16 + 1) / 3):.2f} (" in text  # forecast after


@pytest.mark.slow
def test_drag_is_found_and_its_absence_too():
    options = {"sd": 0.05, "exponent": 1.0}
    pair = [drop(3.0, **options), drop(3.0, **options, seed=1, start=0.0, number=2)]
    found, _ = benchmark.score(*pair)
    assert found["probability_of_drag"] > 0.9
    assert found["forecast after"] < 0.5 < found["forecast before"]
    assert found["second drop after"] < 0.1
    still = [drop(0.0, **options), drop(0.0, **options, seed=1, number=2)]
    loop = Criticism(
        make_simulator(), make_prior(), trials_of(still), effects=make_effects()
    )
    assert loop.trace().verdict == "none"
