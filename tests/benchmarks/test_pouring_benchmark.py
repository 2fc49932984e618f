import numpy as np
import pytest
import torch

from benchmarks.pouring.bank import (
    AT_A_THETA,
    LIKELY,
    ROWS_A_FILE,
    draw,
)
from benchmarks.pouring.figures import log_prob_figure, selected_figure
from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    doubted,
    observed,
    repeated,
    thumbnails,
)
from benchmarks.pouring.power import cross_validated, grid
from benchmarks.pouring.reference import abc_log_prob
from sbi_active.tasks import get_task  # pyright: ignore


def pours(n, seed=0, noise=0.1):
    """Summaries of twelve numbers that see theta, and empty where friction is high."""
    rng = np.random.default_rng(seed)
    theta = rng.random((n, 3))
    weight = np.random.default_rng(9).normal(size=(3, 12))
    summary = theta @ weight + noise * rng.standard_normal((n, 12))
    return theta, summary, theta[:, 0] > 0.8


@pytest.fixture(scope="module")
def told():
    return cross_validated(*pours(100))


@pytest.mark.slow
def test_left_out_pours_are_told_as_well_as_the_exact_posterior_tells(told):
    _, log_p, mass = told
    filled = ~pours(100)[2]
    weight = np.random.default_rng(9).normal(size=(3, 12))
    # The entropy of the exact posterior, away from bounds; the grid costs some of it.
    volume = np.linalg.slogdet(weight @ weight.T / 0.1**2)[1]
    exact = 0.5 * volume - 1.5 * np.log(2 * np.pi * np.e)
    cell = 3 * np.log(10)
    assert min(exact, cell) - 1.5 < log_p[filled].mean() < cell
    assert 0.75 < (mass[filled] <= 0.9).mean() <= 1


@pytest.mark.slow
def test_an_image_without_cubes_tells_what_makes_it_empty(told):
    likelihood = told[0]
    cells = grid(6)
    log_p = likelihood.at(cells, None)
    high, low = cells[:, 0] > 0.8, cells[:, 0] < 0.6
    assert log_p[high].min() > log_p[low].max()


def test_outcomes_without_information_have_no_gain():
    rng = np.random.default_rng(1)
    theta = rng.random((60, 3))
    noise = rng.standard_normal((60, 8))
    likelihood, log_p, _ = cross_validated(theta, noise, np.zeros(60, dtype=bool))
    gain = likelihood.gain(rng.random((200, 3)), 100, rng)
    assert abs(log_p.mean()) < 0.3
    assert abs(gain.mean()) < 0.3


@pytest.mark.slow
def test_gain_is_that_of_the_left_out_pours(told):
    likelihood, log_p, _ = told
    theta = np.random.default_rng(2).random((800, 3))
    gain = likelihood.gain(theta, 400, np.random.default_rng(3)).mean()
    assert gain == pytest.approx(log_p.mean(), abs=1.0)


def test_pours_that_are_all_empty_leave_the_prior():
    theta, summary, _ = pours(60)
    fitted = ImageLikelihood.fit(theta, summary, np.ones(60, dtype=bool))
    assert np.ptp(fitted.at(grid(3), observed(fitted, summary[0], True))) == 0
    assert np.isfinite(fitted.at(grid(3), observed(fitted, summary[0], False))).all()


def test_nearest_pours_tell_less_than_the_exact_posterior_and_more_than_the_prior():
    theta, summary, _ = pours(220, noise=1.0)
    weight = np.random.default_rng(9).normal(size=(3, 12))
    volume = np.linalg.slogdet(weight @ weight.T + 12 * np.eye(3))[1]
    most = 0.5 * volume - 1.5 * np.log(2 * np.pi * np.e)  # with a normal prior
    log_p = abc_log_prob(theta, summary)
    assert 0.2 < log_p.mean() < most + 1.0


def test_thumbnails_and_components_keep_where_cubes_lie():
    images = np.zeros((6, 150, 150), np.float32)
    for k, image in enumerate(images):
        image[20 * k : 20 * k + 10, 40:50] = 4.0
    small = thumbnails(images.reshape(6, -1))
    assert small.shape == (6, 900)
    mean, axes = components(small, 36)
    assert axes.shape == (900, 5)  # six images span five dimensions
    back = mean + (small - mean) @ axes @ axes.T
    np.testing.assert_allclose(back, small, atol=1e-8)


def test_a_repeat_tells_less_than_a_first_pour():
    mean, error, noise = np.array([[0.0]]), np.array([[0.04]]), np.array([[1.0]])
    first = repeated(mean, error, noise, [], 0.2)
    assert first[0] == 0
    assert first[1] == pytest.approx(np.sqrt(1.04))
    # The error that repeats share: exact for normal variables.
    earlier = [np.array([0.5]), np.array([1.5])]
    common, alone = 0.24, 0.8
    cover = common + alone * np.eye(3)
    known = cover[2, :2] @ np.linalg.inv(cover[:2, :2])
    moved = repeated(mean, error, noise, earlier, 0.2)
    assert moved[0] == pytest.approx(known @ [0.5, 1.5])
    assert moved[1] ** 2 == pytest.approx(cover[2, 2] - known @ cover[:2, 2])
    # Without anything in common, earlier pours of the action change nothing.
    same = repeated(mean, 0 * error, noise, earlier, 0.0)
    assert same[0] == 0
    assert same[1] == 1


def test_what_may_tell_nothing_is_bounded():
    log_p = np.log(np.array([1e-30, 1.0, 2.0]))
    assert doubted(log_p, 1.0) == pytest.approx(
        np.log([0.1, 0.9 + 0.1, 1.8 + 0.1]), abs=1e-9
    )
    assert doubted(0.5 * log_p, 0.5) == pytest.approx(0.5 * doubted(log_p, 1.0))
    assert (doubted(np.zeros(3), 0.0) == 0).all()


def test_repeats_far_out_widen_what_is_expected():
    theta, summary, empty = pours(60)
    fitted = ImageLikelihood.fit(theta, summary, np.zeros_like(empty))
    there = np.array([[0.5, 0.5, 0.5]])
    mean, spread, freedom = fitted.predict(there)
    near, far = mean[0], mean[0] + 8 * spread[0]
    close, wide = (fitted.predict(there, [x])[1:] for x in (near, far))
    assert close[1] == wide[1] == freedom + 3
    assert (close[0] < spread).all()
    assert (wide[0] > 1.3 * close[0]).all()


def test_noise_that_grows_with_theta_is_seen():
    rng = np.random.default_rng(0)
    theta = rng.random((240, 3))
    size = np.exp(1.5 * theta[:, :1])
    summary = theta + 0.05 * size * rng.standard_normal((240, 3))
    fitted = ImageLikelihood.fit(theta, summary, np.zeros(240, dtype=bool))
    ends = np.array([[0.1, 0.5, 0.5], [0.9, 0.5, 0.5]])
    _, _, noise = fitted.parts(ends)
    ratio = np.sqrt(noise[1] / noise[0])
    assert ratio.min() > 1.5
    assert ratio.max() < 6  # 3.3


def test_a_bank_of_repeats_pours_each_theta_again():
    pytest.importorskip("pybullet")
    task = get_task("pouring")
    rows = draw(task, "repeats", 0)
    theta, action, seeds = rows.theta, rows.action, rows.seeds
    assert len(seeds.unique()) == ROWS_A_FILE
    for k in range(0, ROWS_A_FILE, AT_A_THETA):
        assert len(theta[k : k + AT_A_THETA].unique(dim=0)) == 1
        assert len(action[k : k + AT_A_THETA].unique(dim=0)) == 1
    assert len(theta.unique(dim=0)) == ROWS_A_FILE // AT_A_THETA
    action = draw(task, "likely", 0).action
    assert len(action.unique(dim=0)) == len(LIKELY)
    first, again = draw(task, "prior", 0).theta, draw(task, "prior", 0).theta
    assert torch.equal(first, again)
    assert len(first.unique(dim=0)) == ROWS_A_FILE


def test_figures_are_drawn_of_the_rows(tmp_path):
    header = "seed,round,height,position,rate,delta,log_prob_true\n"
    for target in ("1", "2"):
        rows = [f"{s},{r},20,0,2,{s % 2},{r + s}" for s in (1, 2) for r in (1, 2)]
        for method in ("asbi", "alhi"):
            path = tmp_path / f"target_{target}_{method}.csv"
            path.write_text(header + "\n".join(rows) + "\n")
    first, second = log_prob_figure(tmp_path).axes
    assert [line.get_label() for line in first.get_legend().get_lines()] == [
        "ASBI",
        "ALHI",
    ]
    middle = next(line for line in first.lines if line.get_label() == "ASBI")
    assert [*middle.get_ydata()] == [2.5, 3.5]  # medians of the two trials
    bars = selected_figure(tmp_path).axes[0].patches
    assert [bar.get_height() for bar in bars] == [0.5] * 4
