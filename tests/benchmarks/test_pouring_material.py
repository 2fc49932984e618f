import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring.material.bank import PLACES, draw  # noqa: E402
from benchmarks.pouring.material.learned import (  # noqa: E402
    Overlap,
    PointBelief,
    beside,
    cross_validated,
)
from benchmarks.pouring.material.summary import (  # noqa: E402
    by_round,
    intervol_figure,
    summarize,
)
from sbi_active.tasks import get_task  # pyright: ignore  # noqa: E402


@pytest.fixture(scope="module")
def task():
    return get_task("pouring_real", cubes=8)


def test_rows_of_the_bank_are_shared_out_by_place(task):
    rows = [draw(task, "prior", k) for k in range(8)]
    action = torch.cat([r.action for r in rows])
    share = [(action[:, 1] == place).float().mean().item() for place in PLACES]
    assert share == pytest.approx([0.4, 0.5, 0.1], abs=0.08)
    known = {tuple(a) for a in task.actions.values.tolist()}
    assert {tuple(a) for a in action.tolist()} <= known
    assert torch.equal(draw(task, "prior", 0).theta, rows[0].theta)
    assert not torch.equal(rows[1].theta, rows[0].theta)
    assert len(draw(task, "compared", 0).action.unique(dim=0)) == 1


def test_a_belief_by_points_has_the_mean_of_its_weights():
    prior = PointBelief.uniform()
    points = prior.points()
    assert points.mean(0) == pytest.approx(np.full(8, 0.5), abs=1e-3)
    assert prior.effective == pytest.approx(len(points))
    # A normal likelihood of one parameter, well inside.
    belief = PointBelief(-0.5 * ((points[:, 2] - 0.4) / 0.05) ** 2)
    assert belief.weight @ points[:, 2] == pytest.approx(0.4, abs=2e-3)
    share = 0.05 * np.sqrt(4 * np.pi)  # of the prior's points, effective
    assert belief.effective / len(points) == pytest.approx(share, rel=0.02)
    draws = belief.sample(400, 0)
    assert draws[:, 2].std() == pytest.approx(0.05, rel=0.15)
    assert np.array_equal(belief.sample(400, 0), draws)


def test_the_volume_that_a_belief_shares_is_the_mean_over_its_draws():
    rng = np.random.default_rng(0)
    theta = rng.random((120, 8))
    volume = 5_000 + 3_000 * theta[:, 3] + 200 * rng.standard_normal(120)
    overlap = Overlap.fit(theta, volume)
    assert overlap.explained == pytest.approx(0.95, abs=0.03)
    assert overlap.mean(PointBelief.uniform()) == pytest.approx(6_500, abs=80)
    points = PointBelief.points()
    high = PointBelief(np.where(points[:, 3] > 0.8, 0.0, -1e3))
    assert overlap.mean(high) == pytest.approx(7_700, abs=100)


def test_a_likelihood_takes_height_and_rate_beside_theta():
    rng = np.random.default_rng(1)
    num = 150
    theta = rng.random((num, 8))
    action = np.stack(
        [
            rng.choice([15, 35, 55], num),
            np.zeros(num),
            rng.choice([0.2, 0.9, 1.6], num),
        ],
        1,
    )
    known = beside(theta, action)
    assert known.shape == (num, 10)
    assert (known[:, 8:].min(0) == 0).all()
    assert (known[:, 8:].max(0) == 1).all()
    # Forty numbers that see two parameters, and move with the action.
    weight = rng.normal(size=(4, 40))
    seen = np.stack([theta[:, 0], theta[:, 5], *known[:, 8:].T], 1)
    summary = seen @ weight + 0.3 * rng.standard_normal((num, 40))
    fitted, told, mass = cross_validated(theta, action, summary, np.zeros(num, bool))
    assert fitted.statistic is not None
    assert fitted.sd.shape == (2,)  # the other six tell nothing, and are left out
    assert told.mean() > 1.0
    assert 0.8 < (mass <= 0.9).mean() <= 1
    at = np.full((3, 8), 0.5)
    at[1, 0], at[2, 1] = 0.9, 0.9
    image = fitted.statistic(np.array([[0.5, 0.5, 0.5, 0.5]]) @ weight)[0]
    found = fitted.at(beside(at, np.array([35, 0, 0.9])), image)
    assert found[0] > found[1] + 1
    assert found[2] == pytest.approx(found[0], abs=1)


def test_the_table_and_the_figure_say_what_the_rows_say(tmp_path):
    rows = [
        {
            "seed": str(seed),
            "material": material,
            "method": method,
            "round": str(number),
            "height": "15" if number else "",
            "position": "0" if number else "",
            "intervol": str(1_000 * (1 + number * (method == "asbi")) + seed),
        }
        for seed in (1, 2, 3)
        for material in ("beads", "gravel")
        for method in ("asbi", "nsbi")
        for number in (0, 1)
    ]
    assert [v.tolist() for v in by_round(rows, "beads", "asbi")] == [
        [1_001, 1_002, 1_003],
        [2_001, 2_002, 2_003],
    ]
    text = summarize(rows)
    assert "1002 / 2002" in text
    assert "2.00 of NSBI's at the last" in " ".join(text.split())
    assert "above it in 3 of 3 pairs" in " ".join(text.split())
    assert summarize([]) == "no trials yet"
    lines = [",".join(rows[0])] + [",".join(r.values()) for r in rows]
    (tmp_path / "intervol.csv").write_text("\n".join(lines) + "\n")
    axes = intervol_figure(tmp_path).axes
    middle = next(line for line in axes[0].lines if line.get_label() == "ASBI")
    assert [*middle.get_ydata()] == [1_002, 2_002]
    assert np.round(np.mean(middle.get_xdata()), 6) == pytest.approx(0.3, abs=0.3)
