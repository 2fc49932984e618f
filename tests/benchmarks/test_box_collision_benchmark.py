import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")
from benchmarks.box_collision.bank import PriorBank  # noqa: E402
from benchmarks.box_collision.summary import (  # noqa: E402
    REPORTED,
    STAGES,
    coverage_table,
    summarize,
)


def rows(speed, log_prob, hpd=0.3, num=4, rounds=6):
    """Rows as a CSV file has them; seed k is k / 10 nats better than seed 0."""
    row = {f"{name}_{s:g}": "2" for s in REPORTED for name in ("rep_err",)}
    row |= {f"exact_rep_err_{s:g}": "1" for s in REPORTED}
    row |= {f"{kind}_{s}": "1" for s in STAGES for kind in ("cpu", "wall")}
    row |= {"num_simulations": "9", "is_valid": "1", "log_p_exact_se": "0.05"}
    return [
        row
        | {
            "seed": str(seed),
            "round": str(r + 1),
            "speed": str(speed + (seed == 0)),
            "log_prob_true": str(log_prob + seed / 10),
            "gap": str(0.1 * seed) if r + 1 == rounds else "",
            "hpd": str(hpd if seed else 0.95),
        }
        for seed in range(num)
        for r in range(rounds)
    ]


def test_a_reference_that_failed_is_no_gap():
    trials = rows(5.0, 3.0)
    trials[5]["log_p_exact_se"] = "0.9"  # seed 0, the last round
    text = summarize({("asbi", "1"): trials})
    assert "0.20 +- 0.06, 0.29 (0.05), 1 of 4 unknown" in text  # gaps .1, .2, .3


def test_coverage_has_a_binomial_interval():
    text = coverage_table({("asbi", "prior"): rows(5.0, 1.0, num=40)})
    # 39 of 40 within 50 % is too many; within 90 % the interval is 32 to 39.
    assert "0.975 outside [0.350, 0.650]" in text
    assert "0.975 within [0.800, 0.975]" in text


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
