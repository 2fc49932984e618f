import pytest
import torch

from sbi_active import simulate
from sbi_active.campaign import Trial
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")
from benchmarks.box_collision.bank import PriorBank  # noqa: E402
from benchmarks.box_collision.run import COLUMNS, SETTINGS, errors, main  # noqa: E402
from benchmarks.box_collision.summary import (  # noqa: E402
    REPORTED,
    STAGES,
    coverage_table,
    draw,
    save,
    summarize,
    time_parts,
)
from benchmarks.rows import read  # noqa: E402
from sbi_active.tasks.box_collision import exact_posterior  # pyright: ignore  # noqa: E402


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


def test_a_reference_that_failed_is_no_gap():
    trials = rows(5.0, 3.0)
    trials[5]["log_p_exact_se"] = "0.9"  # seed 0, the last round
    text = summarize({("asbi", "1"): trials})
    assert "0.20 +- 0.06, 0.29 (0.05), 1 of 4 unknown" in text  # gaps .1, .2, .3


@pytest.mark.slow
def test_references_are_added_to_recorded_trials(tmp_path, monkeypatch):
    task = get_task("box_collision", target=1)
    x = task.real_system(torch.tensor([4.0]), seed=0)
    recorded = dict.fromkeys(COLUMNS, "1") | {"seed": "0", "round": "1", "speed": "4"}
    recorded |= {"log_p_exact": "", "gap": "", "log_prob_true": "0.5"}
    recorded |= dict(zip("xyz", map(str, x.tolist()), strict=True))
    file = tmp_path / "default_target_1_asbi_rounds_1.csv"
    lines = [",".join(COLUMNS), ",".join(recorded[name] for name in COLUMNS)]
    file.write_text("\n".join(lines) + "\n")
    options = "--table references --target 1 --methods asbi --rounds 1 --particles 20"
    monkeypatch.setattr("sys.argv", ["run", *options.split(), f"--results={tmp_path}"])
    main()
    (row,) = read(file)
    trial = Trial(0, torch.tensor([4.0]), x, "ok")
    seed = derive_seed(0, "reference")
    exact = exact_posterior(task, [trial], num_particles=20, seed=seed)
    expected = float(exact.log_prob(task.theta_true[None])[0])
    assert float(row["log_p_exact"]) == pytest.approx(expected, abs=1e-3)
    assert float(row["gap"]) == pytest.approx(expected - 0.5, abs=1e-3)
    before = file.read_text()
    main()  # nothing is left to add
    assert file.read_text() == before


def test_coverage_has_a_binomial_interval():
    text = coverage_table({("asbi", "prior"): rows(5.0, 1.0, num=40)})
    # 39 of 40 within 50 % is too many; within 90 % the interval is 32 to 39.
    assert "0.975 outside [0.350, 0.650]" in text
    assert "0.975 within [0.800, 0.975]" in text


def test_figures_draw_medians_speeds_and_times(tmp_path, monkeypatch):
    figures = {}

    def keep(figure, path):
        figures[path.name] = figure
        return save(figure, path)

    monkeypatch.setattr("benchmarks.box_collision.summary.save", keep)
    cells = {("asbi", "1"): rows(5.0, 3.0), ("nsbi", "1"): rows(9.0, 1.0)}
    for row in (row for part in cells.values() for row in part):
        row |= {f"wall_{stage}": str(k + 2) for k, stage in enumerate(STAGES)}
    paths = draw(cells, tmp_path / "figures")
    assert [path.name for path in paths] == ["log_prob.png", "speeds.png", "time.png"]
    assert [*figures] == [path.name for path in paths]
    (ax,) = figures["log_prob.png"].axes
    # Seeds k are k / 10 nats better than seed 0; six rounds, ASBI left of NSBI.
    medians = ax.lines[4::6][:12]  # beside whiskers, caps and outliers
    heights = [float(line.get_ydata().mean()) for line in medians]
    assert heights == pytest.approx(6 * [3.15] + 6 * [1.15])
    places = [float(line.get_xdata().mean()) for line in medians]
    expected = [r + shift for shift in (-0.125, 0.125) for r in range(1, 7)]
    assert places == pytest.approx(expected)
    for ax, speed in zip(figures["speeds.png"].axes, (5.25, 9.25), strict=True):
        (line,) = ax.lines  # one seed of four is 1 m/s faster
        assert line.get_xydata().tolist() == [[r, speed] for r in range(1, 7)]
        band = ax.collections[0].get_paths()[0].get_extents()
        assert (band.y0, band.y1) == pytest.approx((speed - 0.433, speed + 0.433), 1e-3)
    (ax,) = figures["time.png"].axes
    heights = [*time_parts(cells["asbi", "1"], "wall").values()]
    assert [bar.get_height() for bar in ax.patches] == 2 * heights
    bottoms = [sum(heights[:k]) for k in range(len(heights))]
    assert [bar.get_y() for bar in ax.patches] == 2 * bottoms
    assert sum(heights) == sum(range(2, 2 + len(STAGES)))


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
