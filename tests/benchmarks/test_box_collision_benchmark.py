import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")
from benchmarks.box_collision.bank import PriorBank  # noqa: E402


def test_a_bank_gives_what_it_was_given(tmp_path):
    task = get_task("box_collision")
    theta = torch.rand(12, 3, generator=torch.Generator().manual_seed(0))
    action = torch.linspace(1, 12, 12)[:, None]
    found = []
    for turn in range(2):
        bank = PriorBank(tmp_path, task)
        x = simulate(bank.simulator, theta, action, seed=3).x
        found.append(x.nan_to_num())
        assert bank.num_reused == 12 * turn
        bank.is_open = False
        simulate(bank.simulator, theta, action, seed=3)
        assert bank.num_reused == 12 * turn
        bank.close()
    assert torch.equal(*found)
    exact = simulate(task.simulator, theta, action, seed=3).x.nan_to_num()
    assert torch.allclose(found[0], exact, atol=1e-6)
