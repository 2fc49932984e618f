"""The scene of colliding boxes, its effects, and its reference."""

import math
from functools import partial

import pytest
import torch

from sbi_active import GaussianNoise, SimulatorModel, simulate
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.box_collision import BoxCollisionReference
from sbi_active.tasks.box_collision.model import positions
from sbi_active.tasks.box_collision.scene import LocalScene

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def task():
    return get_task("box_collision")


def rows(num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    theta = torch.rand(num, 3, generator=generator)
    action = 0.5 * torch.randint(41, (num, 1), generator=generator).float()
    return theta, action


def test_early_exit_keeps_the_outcome():
    from sbi_active.tasks.box_collision.scene import Scene  # pyright: ignore

    early, full = Scene(), Scene(early_exit=False)
    theta, action = rows(75)
    slippery = [[0.05, 0.1, 0.3]] * 20  # fast ones leave, slow ones just stay
    theta, speeds = theta.tolist() + slippery, action[:, 0].tolist()
    speeds += [1.0 + 0.1 * i for i in range(20)]
    num_left = steps = 0
    for parameters, speed in zip(theta, speeds, strict=True):
        x, exact = early.run(parameters, speed), full.run(parameters, speed)
        steps += early.steps
        num_left += exact is None
        assert (x is None) == (exact is None)
        if x is not None:
            assert abs(x - exact).max() < 5e-4  # a tenth of the noise
    assert full.steps == 400
    assert steps < 0.5 * 400 * len(speeds)
    assert 25 < num_left < 80


def test_observations_are_bit_identical(task):
    theta, action = rows(60)
    x = simulate(task.simulator, theta, action, seed=3).x
    again = simulate(get_task("box_collision").simulator, theta, action, seed=3).x
    one_by_one = simulate(task.simulator, theta, action, seed=3, batch_size=7).x
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    mean = task.simulator.mean(theta, action)
    assert torch.equal(mean[order].nan_to_num(), permuted(task, theta, action, order))
    for other in (again, one_by_one):
        assert torch.equal(x.nan_to_num(), other.nan_to_num())


def permuted(task, theta, action, order):
    return task.simulator.mean(theta[order], action[order]).nan_to_num()


def test_threads_have_a_scene_each(task):
    from concurrent.futures import ThreadPoolExecutor

    theta, action = rows(40)
    alone = task.simulator.mean(theta, action).nan_to_num()
    with ThreadPoolExecutor(2) as pool:
        parts = [(theta, action)] * 4
        for x in pool.map(lambda part: task.simulator.mean(*part), parts):
            assert torch.equal(x.nan_to_num(), alone)


def test_the_paper_s_code_for_what_left_the_table():
    task = get_task("box_collision", left_table="paper", noise=0.0, target=2)
    x = task.real_system(torch.tensor([10.0]), seed=0)
    assert x.tolist() == [-1.0, -1.0, -1.0]
    theta, action = rows(4)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        simulate(task.simulator, theta, action, seed=0, check_noise=True)


pytest.importorskip("mujoco")

TASK = get_task("box_collision")
EFFECTS = {effect.name: effect for effect in TASK.effects()}

# Name: strength, and the sign of the shift of x (or y) at a low friction.
SIGNS = {
    "restitution": (0.7, 0, 1),
    "viscosity": (0.5, 0, -1),
    "air": (1.2, 0, -1),
    "tilt": (1.0, 0, 1),
    "speed gain": (-0.05, 0, -1),
    "speed offset": (0.3, 0, 1),
    "aim": (0.01, 1, -1),
    "center of mass": (0.01, 1, 1),
    "pusher friction": (0.3, 0, -1),
    "force": (0.3, 0, 1),
    "camera bias": (0.01, 0, 1),
    "camera scale": (0.02, 0, 1),
    "time stamp": (0.05, 0, 1),
}


def evaluate(name, phi, theta, action):
    simulator = AugmentedSimulator(TASK.simulator, [EFFECTS[name]])
    return simulator.evaluate(theta, {name: phi}, action)


@pytest.mark.parametrize("name", EFFECTS)
def test_moves_the_cube_as_it_should(name):
    strength, axis, sign = SIGNS[name]
    theta, action = torch.full((1, 3), 0.2), torch.tensor([[5.0]])
    wide = SimulatorModel(
        positions, noise=GaussianNoise(TASK.noise), setup=partial(LocalScene, edge=10.0)
    )
    simulator = AugmentedSimulator(wide, [EFFECTS[name]])
    x = simulator.evaluate(theta, {name: torch.full((1, 1), strength)}, action)
    shift = float((x - wide.mean(theta, action))[0, axis])
    assert sign * shift > TASK.noise  # a shift that one trial can show


pytest.importorskip("mujoco")

SD = 0.02


def slide(theta, action):
    """A closed form like the scene: x grows with the speed, and ends at an edge."""
    table, cube, density = theta.double().unbind(-1)
    speed = action.double()[:, 0] / (1 + 3 * density)
    x = speed.square() / (4 + 16 * (table + 0.5 * cube))
    x = x.where(x < 1, torch.nan)
    return torch.stack([x, 0 * x, 0 * x + 0.075], -1)


MODEL = SimulatorModel(slide, noise=GaussianNoise(SD))
TRUTH = torch.tensor([[0.6, 0.5, 0.4]])


def trials(*speeds):
    action = torch.tensor(speeds)[:, None]
    seeds = torch.arange(len(speeds))
    return action, MODEL(TRUTH.expand(len(speeds), 3), action, seeds)


def log_likelihood(theta, action, x):
    """Written anew, trial by trial."""
    total = torch.zeros(len(theta), dtype=torch.float64)
    for xi, observed in zip(action, x, strict=True):
        mean = slide(theta, xi.expand(len(theta), 1))
        off = mean[:, 0].isnan()
        if observed.isnan().all():
            total = total.where(off, -torch.inf)
        else:
            z = (observed - mean) / SD
            log_density = (-0.5 * z**2 - math.log(SD * math.sqrt(2 * math.pi))).sum(-1)
            total = (total + log_density).where(~off, -torch.inf)
    return total


def grid(num):
    middle = (torch.arange(num, dtype=torch.float64) + 0.5) / num
    return torch.cartesian_prod(middle, middle, middle)


@pytest.mark.parametrize("speeds", [(3.0, 5.0), (2.0, 4.0, 12.0)])
def test_agrees_with_a_grid(speeds):
    action, x = trials(*speeds)
    assert bool(x.isnan().any()) == (12.0 in speeds)
    reference = BoxCollisionReference(MODEL, action, x, num_simulations=24_000)
    theta = grid(100)
    log_weight = log_likelihood(theta, action, x)
    log_evidence = log_weight.logsumexp(0) - math.log(len(theta))
    se = reference.log_evidence_se
    assert 0 < se < 0.05
    # The midpoint rule is off by far less than the draws.
    assert abs(reference.log_evidence - float(log_evidence)) < 4 * se
    assert float(reference.log_prob(TRUTH)) == pytest.approx(
        float(log_likelihood(TRUTH, action, x)[0]) - reference.log_evidence
    )
    weight = log_weight.softmax(0)
    mean = weight @ theta
    sd = (weight @ (theta - mean) ** 2).sqrt()
    draws = reference.sample(4000, seed=0)
    error = sd / reference.effective_sample_size**0.5 + sd / 4000**0.5
    assert bool(((draws.mean(0) - mean).abs() < 4 * error).all())
    assert reference.num_simulations <= 24_000 + 1 * len(speeds)
