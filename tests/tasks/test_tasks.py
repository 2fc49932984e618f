import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore


def test_unknown_task_lists_the_valid_names():
    with pytest.raises(ValueError, match="expected a task among 'numerical'.*'abc'"):
        get_task("abc")


@pytest.mark.parametrize("variant", ["linear", "sinh", "square"])
def test_the_simulator_and_the_oracle_are_one_model(variant):
    """Ranks of the truth's exact density among exact draws are uniform."""
    task = get_task("numerical", variant=variant)
    num = 80
    theta = task.prior.sample((num,))
    action = task.actions.sample((num,), seed=0)
    x = simulate(task.simulator, theta, action, seed=0).x
    ranks = []
    for i in range(num):
        exact = task.reference(action[i : i + 1], x[i : i + 1])
        draws = exact.log_prob(exact.sample(200, seed=i))
        ranks.append(float((draws < exact.log_prob(theta[i : i + 1])).double().mean()))
    mean = torch.tensor(ranks).mean()
    # A uniform has mean .5 and sd .289.
    assert abs(float(mean) - 0.5) < 4 * 0.289 / num**0.5
