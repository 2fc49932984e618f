import sys

import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def task():
    return get_task("box_collision")


def rows(num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    theta = torch.rand(num, 3, generator=generator)
    action = 0.5 * torch.randint(41, (num, 1), generator=generator).float()
    return theta, action


def test_momentum_passes_to_the_cube(task):
    """A light, slippery cube leaves faster than the pusher, never twice as fast."""
    from sbi_active.tasks.box_collision.scene import Scene  # pyright: ignore

    scene = Scene(edge=50.0)
    scene.prepare([0.0, 0.0, 0.1], 2.0)
    momentum = 2.0  # kg m/s, of the 1 kg pusher
    lost = 9.81 * 0.25  # N: the pusher's own friction .25 on the table
    for _ in range(100):
        scene.mujoco.mj_step(scene.model, scene.data, 1)
    velocity = scene.data.qvel
    total = velocity[0] + 0.1 * 3.375 * velocity[6]
    assert 1.0 < velocity[6] < 4.0
    # Friction takes momentum for .25 s at the most; contact friction is elastic-free.
    assert momentum - lost * 0.25 - 1e-3 < total < momentum


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


class Point:
    def __init__(self, *theta):
        self.theta = torch.tensor(theta)

    def sample(self, shape):
        return self.theta.expand(*shape, 3)


def test_reproduction_error_counts_the_code_of_a_fall():
    task = get_task("box_collision", target=2)
    table = task.reproduction_table(Point(0.2, 0.2, 0.2))
    assert table == {3.0: 0.0, 5.0: 0.0, 7.0: 0.0}  # both fall from 5 m/s on
    stays = Point(0.8, 0.8, 0.8)
    x = task.simulator.mean(stays.sample((1,)), torch.full((1, 1), 5.0))
    distance = float((x + 1).norm())
    error = task.reproduction_error(stays, 5.0, num_samples=2)
    assert error == pytest.approx(distance)


def test_theta_outside_the_box_is_refused(task):
    theta = torch.tensor([[0.5, 0.5, 0.5], [0.5, 1.5, 0.5]])
    with pytest.raises(ValueError, match=r"expected theta within \[0, 1\].*in row 1"):
        task.simulator(theta, torch.ones(2, 1))


def test_missing_mujoco_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'sbi-active\[mujoco\]'"):
        get_task("box_collision")
