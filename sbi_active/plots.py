"""Figures of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.display.figures import legible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_belief(
    belief: Distribution,
    ax: Axes,
    *,
    parameter_names: Sequence[str],
    limits: Tensor,
    theta_true: Tensor | None = None,
    pair: tuple[int, int] = (0, 1),
    num_samples: int = 4_000,
) -> None:
    """Draw a belief over two parameters as a cloud of its samples.

    Args:
        belief: The belief.
        ax: Axes to draw on.
        parameter_names: Names of the parameters.
        limits: Lower and upper ends of the axes, shape (2, theta_dim).
        theta_true: True parameters, marked by a cross where given.
        pair: Pair of parameters to draw.
        num_samples: Number of samples to draw.
    """
    i, j = pair
    theta = belief.sample((num_samples,)).numpy()
    ax.plot(theta[:, i], theta[:, j], ".", ms=1.5, alpha=0.25, color="C0", zorder=1)
    if theta_true is not None:
        ax.plot(
            theta_true[i], theta_true[j], "x", color="C3", ms=8, mew=2, label="truth"
        )
    ax.set(
        xlim=limits[:, i].tolist(),
        ylim=limits[:, j].tolist(),
        xlabel=parameter_names[i],
        ylabel=parameter_names[j],
    )
    ax.locator_params(axis="x", nbins=4)  # labels of a narrow belief are long


def plot_rounds(
    beliefs: Sequence[Distribution],
    designs: Sequence[Design],
    *,
    parameter_names: Sequence[str],
    theta_true: Tensor | None = None,
    exact_gains: Sequence[Tensor | None] | None = None,
) -> Figure:
    """Draw each round in a row: belief, information gain of the actions, next belief.

    The layout is that of figure 3 of Kim & Matsubara (2025).

    Args:
        beliefs: Beliefs before the first round and after each, one more than designs.
        designs: Designs, one a round.
        parameter_names: Names of the parameters.
        theta_true: True parameters, marked where given.
        exact_gains: Exact gains of every candidate, one tensor a round, where known.

    Returns:
        The figure.

    Raises:
        ValueError: If there is not one belief more than there are designs.
    """
    import matplotlib.pyplot as plt

    if len(beliefs) != len(designs) + 1:
        raise ValueError(
            "expected one belief more than designs, the first before any trial; got "
            f"{len(beliefs)} and {len(designs)}; add the prior in front"
        )
    figure, axes = plt.subplots(
        len(designs), 3, figsize=(11, 2.9 * len(designs)), squeeze=False
    )
    bounds = [_bounds(belief) for belief in beliefs]
    for r, (design, row) in enumerate(zip(designs, axes, strict=True)):
        for ax, belief, title in (
            (row[0], beliefs[r], f"round {r + 1}: belief before"),
            (row[2], beliefs[r + 1], "belief after"),
        ):
            plot_belief(
                belief,
                ax,
                parameter_names=parameter_names,
                limits=bounds[r],
                theta_true=theta_true,
            )
            ax.set_title(title, fontsize=10)
        _plot_gain(row[1], design, None if exact_gains is None else exact_gains[r])
    figure.tight_layout()
    return figure


def _plot_gain(ax: Axes, design: Design, exact: Tensor | None) -> None:
    if design.expected_information_gain.isnan().all():
        ax.axvline(float(design.action[0]), ls=":", color="k", label="chosen at random")
        ax.set(xlabel=design.name, ylabel="EIG [nats]")
    else:
        design.plot(ax)
    if exact is not None and design.candidates.shape[1] == 1:
        ax.plot(design.candidates[:, 0], exact, "-", color="C1", label="exact")
    action = ", ".join(f"{a:g}" for a in design.action.tolist())
    ax.set_title(f"chosen action {action}", fontsize=10)
    ax.legend(fontsize=8)


def _bounds(belief: Distribution) -> Tensor:
    """Return lower and upper limits that hold nearly all draws, shape (2, d)."""
    theta = belief.sample((2_000,)).double()
    levels = torch.tensor([0.001, 0.999], dtype=torch.float64)
    low, high = torch.quantile(theta, levels, dim=0)
    margin = 0.05 * (high - low)
    return torch.stack([low - margin, high + margin]).to(torch.float64)


def save(figure: Figure, path: str) -> None:
    """Write a figure and free it."""
    import matplotlib.pyplot as plt

    legible(figure).savefig(path, dpi=110)
    plt.close(figure)
