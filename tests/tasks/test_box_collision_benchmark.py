import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")
from benchmarks.box_collision.bank import PriorBank  # noqa: E402
from benchmarks.box_collision.run import SETTINGS, errors  # noqa: E402
from benchmarks.box_collision.summary import (  # noqa: E402
    REPORTED,
    STAGES,
    coverage_table,
    draw,
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


def test_summary_compares_targets_methods_and_the_paper():
    cells = {
        ("asbi", "1"): rows(5.0, 3.0),
        ("asbi", "2"): rows(4.5, 2.0),
        ("nsbi", "2"): rows(9.0, 1.0),
    }
    cells["asbi", "2"][2]["speed"] = "7"  # seed 0 in round 3: faster than 6
    text = summarize(cells)
    assert "ASBI: slower for target 2 in round 3 in 3 of 4 trials (0.75" in text
    assert "target 2: ASBI above NSBI in median log p in 5 of rounds 2 to 6" in text
    assert "+1.00 / +1.00" in text
    assert "703 +- 190" in text  # the paper's
    assert "3.15 / 3.15" in text  # the median over seeds
    assert "0.15 +- 0.06" in text  # gaps 0, .1, .2, .3 of the last round
    assert summarize({}) == "no trials yet"


def test_coverage_has_a_binomial_interval():
    text = coverage_table({("asbi", "prior"): rows(5.0, 1.0, num=40)})
    # 39 of 40 within 50 % is too many; within 90 % the interval is 32 to 39.
    assert "0.975 outside [0.350, 0.650]" in text
    assert "0.975 within [0.800, 0.975]" in text


def test_figures(tmp_path):
    cells = {("asbi", "1"): rows(5.0, 3.0), ("nsbi", "1"): rows(9.0, 1.0)}
    paths = draw(cells, tmp_path / "figures")
    assert [path.name for path in paths] == ["log_prob.png", "speeds.png", "time.png"]
    assert all(path.stat().st_size > 5_000 for path in paths)


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


def test_the_paper_s_setting():
    options, task_options = SETTINGS["paper"]
    assert options.num_simulations == 20_500
    assert options.density_estimator.num_iterations == 2000
    assert options.density_estimator.batch_size == 50
    assert not options.refine
    task = get_task("box_collision", **task_options, target=2)
    assert errors(task, task.prior, "rep_err").keys() == {
        f"rep_err_{speed:g}" for speed in REPORTED
    }
