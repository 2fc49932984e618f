import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore


def test_unknown_task_lists_the_valid_names():
    with pytest.raises(ValueError, match="expected a task among 'numerical'.*'abc'"):
        get_task("abc")


def test_numerical_is_the_paper_s():
    task = get_task("numerical")
    theta = torch.tensor([[-3.0, 1.0], [2.0, -1.0]])
    action = torch.tensor([[3.0], [0.0]])
    expected = [[-3.0 + 3.0], [2 * torch.tensor(3.0).exp().item()]]
    assert torch.allclose(task.simulator.mean(theta, action), torch.tensor(expected))
    assert len(task.actions) == 21
    assert task.theta_true.tolist() == [-3.0, 1.0]
    assert task.simulator.noise.sd == 1.0
    assert task.parameter_names == ["theta_1", "theta_2"]


@pytest.mark.parametrize("variant", ["linear", "sinh", "square"])
def test_the_simulator_and_the_oracle_are_one_model(variant):
    """Ranks of the truth's exact density among exact draws are uniform."""
    task = get_task("numerical", variant=variant)
    theta = task.prior.sample((150,))
    action = task.actions.sample((150,), seed=0)
    x = simulate(task.simulator, theta, action, seed=0).x
    ranks = []
    for i in range(150):
        exact = task.reference(action[i : i + 1], x[i : i + 1])
        draws = exact.log_prob(exact.sample(200, seed=i))
        ranks.append(float((draws < exact.log_prob(theta[i : i + 1])).double().mean()))
    mean = torch.tensor(ranks).mean()
    # A uniform has mean .5 and sd .289.
    assert abs(float(mean) - 0.5) < 4 * 0.289 / 150**0.5


def test_real_system_is_the_simulator_at_the_truth():
    task = get_task("numerical")
    x = torch.stack([task.real_system(torch.tensor([0.0]), seed=s) for s in range(400)])
    truth = -3 * torch.tensor(3.0).exp()
    assert abs(float(x.mean() - truth)) < 4 / 400**0.5
    assert torch.equal(task.real_system(torch.zeros(1), seed=1), x[1])
