"""The scene of colliding boxes, its effects, and its reference."""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
import torch
from torch.distributions import Normal

from sbi_active import SimulatorModel, simulate
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task
from sbi_active.tasks.box_collision import BoxCollisionReference
from sbi_active.tasks.box_collision.model import positions
from sbi_active.tasks.box_collision.scene import LocalScene

pytest.importorskip("mujoco")


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


def test_observations_are_bit_identical():
    theta, action = rows(60)
    x = simulate(TASK.simulator, theta, action, seed=3).x.nan_to_num()
    again = simulate(get_task("box_collision").simulator, theta, action, seed=3).x
    few = simulate(TASK.simulator, theta, action, seed=3, batch_size=7).x
    for other in (again, few):
        assert torch.equal(x, other.nan_to_num())
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    mean = TASK.simulator.mean(theta, action).nan_to_num()
    turned = TASK.simulator.mean(theta[order], action[order]).nan_to_num()
    assert torch.equal(mean[order], turned)
    with ThreadPoolExecutor(2) as pool:  # a scene each
        for own in pool.map(lambda _: TASK.simulator.mean(theta, action), range(4)):
            assert torch.equal(own.nan_to_num(), mean)


def test_the_paper_s_code_for_what_left_the_table():
    task = get_task("box_collision", left_table="paper", noise=0.0, target=2)
    x = task.real_system(torch.tensor([10.0]), seed=0)
    assert x.tolist() == [-1.0, -1.0, -1.0]
    theta, action = rows(4)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        simulate(task.simulator, theta, action, seed=0, check_noise=True)


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


@pytest.mark.parametrize("name", EFFECTS)
def test_moves_the_cube_as_it_should(name):
    strength, axis, sign = SIGNS[name]
    theta, action = torch.full((1, 3), 0.2), torch.tensor([[5.0]])
    setup = partial(LocalScene, edge=10.0)
    wide = SimulatorModel(positions, noise=TASK.noise, setup=setup)
    phi = {name: torch.full((1, 1), strength)}
    x = AugmentedSimulator(wide, [EFFECTS[name]]).evaluate(theta, phi, action)
    shift = float((x - wide.mean(theta, action))[0, axis])
    assert sign * shift > TASK.noise  # a shift that one trial can show


SD = 0.02


def slide(theta, action):
    """A closed form like the scene: x grows with the speed, and ends at an edge."""
    table, cube, density = theta.double().unbind(-1)
    speed = action.double()[:, 0] / (1 + 3 * density)
    x = speed.square() / (4 + 16 * (table + 0.5 * cube))
    x = x.where(x < 1, torch.nan)
    return torch.stack([x, 0 * x, 0 * x + 0.075], -1)


MODEL = SimulatorModel(slide, noise=SD)
TRUTH = torch.tensor([[0.6, 0.5, 0.4]])


def log_likelihood(theta, action, x):
    """Written anew, trial by trial."""
    total = torch.zeros(len(theta), dtype=torch.float64)
    for xi, observed in zip(action, x, strict=True):
        mean = slide(theta, xi.expand(len(theta), 1))
        off, lost = mean[:, 0].isnan(), bool(observed.isnan().all())
        log_p = Normal(mean.nan_to_num(), SD).log_prob(observed.nan_to_num()).sum(-1)
        total = (total + (0.0 if lost else log_p)).where(off == lost, -torch.inf)
    return total


@pytest.mark.parametrize("speeds", [(3.0, 5.0), (2.0, 4.0, 12.0)])
def test_agrees_with_a_grid(speeds):
    action, seeds = torch.tensor(speeds)[:, None], torch.arange(len(speeds))
    x = MODEL(TRUTH.expand(len(speeds), 3), action, seeds)
    assert bool(x.isnan().any()) == (12.0 in speeds)
    reference = BoxCollisionReference(MODEL, action, x, num_effective=2_000)
    middle = (torch.arange(100, dtype=torch.float64) + 0.5) / 100
    theta = torch.cartesian_prod(middle, middle, middle)
    log_weight = log_likelihood(theta, action, x)
    log_evidence = float(log_weight.logsumexp(0)) - math.log(len(theta))
    se = reference.log_evidence_se
    assert 0 < se < 0.05
    # The midpoint rule is off by far less than the draws.
    assert abs(reference.log_evidence - log_evidence) < 4 * se
    own = float(log_likelihood(TRUTH, action, x)[0]) - reference.log_evidence
    assert float(reference.log_prob(TRUTH)) == pytest.approx(own)
    weight = log_weight.softmax(0)
    mean = weight @ theta
    sd = (weight @ (theta - mean) ** 2).sqrt()
    draws = reference.sample(4000, seed=0)
    error = sd / reference.effective_sample_size**0.5 + sd / 4000**0.5
    assert bool(((draws.mean(0) - mean).abs() < 4 * error).all())
