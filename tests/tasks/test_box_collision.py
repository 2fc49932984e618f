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
