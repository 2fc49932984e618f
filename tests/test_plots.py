"""What the figures of a campaign draw, number by number."""

import numpy as np
import pytest
import torch
from matplotlib import image
from matplotlib.figure import Figure
from torch.distributions import Independent, Normal

from sbi_active import DiscreteActions, RandomDesigner
from sbi_active.design.design import Design
from sbi_active.plots import plot_belief, plot_rounds, save

NAMES = ["mass", "friction"]
TRUTH = torch.tensor([1.0, 20.0])
GAIN = torch.tensor([0.2, 0.9, 0.5])
ERROR = torch.tensor([0.01, 0.02, 0.03])
EXACT = GAIN + 0.1


def belief(width=1.0):
    mean, sd = TRUTH + 0.1, width * torch.tensor([0.1, 2.0])
    return Independent(Normal(mean, sd), 1)


def design(**changes):
    made = {
        "action": torch.tensor([2.0]),
        "candidates": torch.tensor([[3.0], [2.0], [1.0]]),
        "expected_information_gain": GAIN,
        "standard_error": ERROR,
        "difference_standard_error": ERROR,
        "probability_best": torch.tensor([0.0, 1.0, 0.0]),
        "probability_valid": torch.ones(3),
        "bound": "none",
        "index": 1,
        "num_simulations": 30,
        "name": "push [N]",
    }
    return Design(**(made | changes))


def line(ax, label):
    """Return the points of the line of a label, shape (n, 2)."""
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return np.asarray(found.get_xydata())


def test_a_belief_is_a_cloud_of_its_draws_with_a_cross_at_the_truth():
    ax = Figure().subplots()
    limits = torch.tensor([[0.0, -5.0], [2.0, 45.0]])
    torch.manual_seed(1)
    plot_belief(
        belief(),
        ax,
        parameter_names=NAMES,
        limits=limits,
        theta_true=TRUTH,
        pair=(1, 0),
        num_samples=50,
    )
    torch.manual_seed(1)
    draws = belief().sample((50,))
    np.testing.assert_allclose(ax.lines[0].get_xydata(), draws.flip(1))
    np.testing.assert_allclose(line(ax, "truth"), TRUTH.flip(0)[None])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("friction", "mass")
    assert ax.get_xlim() == (-5.0, 45.0)
    assert ax.get_ylim() == (0.0, 2.0)


def test_a_round_is_a_row_of_belief_gain_and_next_belief():
    torch.manual_seed(0)
    widths = (1.0, 0.3, 0.1)
    figure = plot_rounds(
        [belief(w) for w in widths],
        [design(), design()],
        parameter_names=NAMES,
        theta_true=TRUTH,
        exact_gains=[EXACT, None],
    )
    rows = np.reshape(figure.axes, (2, 3))
    for r, (before, gain, after) in enumerate(rows):
        for ax, width in ((before, widths[r]), (after, widths[r + 1])):
            sd = np.std(ax.lines[0].get_xdata())
            assert sd == pytest.approx(0.1 * width, rel=0.1)
        # Both beliefs have the axes of the first, which hold nearly all of it.
        assert before.get_xlim() == after.get_xlim()
        low, high = before.get_xlim()
        assert (high - low) / (0.1 * widths[r]) == pytest.approx(6.8, abs=0.8)
        assert before.get_title().startswith(f"round {r + 1}")
        assert gain.get_title() == "chosen action 2"
    assert line(rows[0, 1], "exact").tolist() == [
        [float(a), float(e)] for a, e in zip([3, 2, 1], EXACT, strict=True)
    ]
    assert "exact" not in [each.get_label() for each in rows[1, 1].lines]


def test_the_gain_of_each_candidate_stands_at_it_with_two_errors():
    ax = design(bound="lower").plot(Figure().subplots())
    points = ax.lines[0].get_xydata()
    np.testing.assert_allclose(points, [[1, 0.5], [2, 0.9], [3, 0.2]])
    (bars,) = ax.collections
    lengths = [np.ptp(segment[:, 1]) / 4 for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, [0.03, 0.02, 0.01], rtol=1e-5)
    assert line(ax, "chosen")[:, 0].tolist() == [2.0, 2.0]
    assert ax.get_xlabel() == "push [N]"
    assert ax.get_ylabel() == "EIG (lower bound) [nats]"


def test_a_random_choice_has_its_action_and_no_gain():
    random = RandomDesigner(DiscreteActions([1.0, 2.0, 3.0])).select(seed=0)
    torch.manual_seed(0)
    figure = plot_rounds([belief()] * 2, [random], parameter_names=NAMES)
    (ax,) = [each for each in figure.axes if "EIG" in each.get_ylabel()]
    assert len(ax.lines) == 1
    place = line(ax, "chosen at random")[:, 0]
    assert place.tolist() == 2 * [float(random.action)]


def test_a_belief_is_missing():
    with pytest.raises(ValueError, match="one belief more than designs"):
        plot_rounds([belief()], [design()], parameter_names=NAMES)


def test_a_saved_figure_has_its_size_and_its_lines(tmp_path):
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(3, 2))
    ax.plot([0, 1], [0, 1], color=(1, 0, 0), lw=4)
    save(figure, str(tmp_path / "a.png"))
    pixels = image.imread(tmp_path / "a.png")
    assert pixels.shape == (220, 330, 4)
    red = (pixels[..., 0] == 1) & (pixels[..., 1:3] == 0).all(-1)
    assert red.sum() > 300
    assert not plt.fignum_exists(figure.number)
