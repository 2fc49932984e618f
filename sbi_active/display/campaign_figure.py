"""A campaign as one figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.display.panels import plot_design
from sbi_active.display.table import within
from sbi_active.seeding import derive_seed, forked_generators

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Quantiles that are drawn: the median, half and nine tenths of the belief.
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
TRUTH, EXPECTED, FAINT = "#c1432e", "#333333", "#9aa3ab"
BARS = {"ok": "C0", "watch": "#b8860b", "alarm": TRUTH, None: FAINT}


def plot_campaign(
    campaign: Any,
    *,
    theta_true: Tensor | None,
    num_predicted: int,
    most_parameters: int = 24,
) -> Figure:
    """Return the figure of :meth:`.Campaign.plot`.

    Args:
        campaign: The campaign.
        theta_true: True parameters, shape (theta_dim,), where known.
        num_predicted: Simulations of each trial.
        most_parameters: Parameters that have a panel.

    Raises:
        ValueError: If ``theta_true`` has another number of parameters.
    """
    import matplotlib.pyplot as plt

    names = campaign.parameter_names
    truth = [] if theta_true is None else torch.as_tensor(theta_true).flatten().tolist()
    # Without the parameters of effects that were adopted, too.
    if len(truth) > len(names):
        raise ValueError(
            f"expected theta_true with at most {len(names)} numbers; got {len(truth)}; "
            "pass one a parameter"
        )
    shown = names[:most_parameters]
    columns = min(max(len(shown), 2), 4 if len(shown) <= 12 else 5)
    rows = -(-len(shown) // columns)
    high = 2.0 * rows if rows > 1 else 2.7
    figure: Any = plt.figure(figsize=(12, high + 3.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[high, 3.6])
    panels = upper.subplots(rows, columns, squeeze=False).ravel()
    numbers, levels = _quantiles(campaign, len(names))
    for k, (ax, name) in enumerate(zip(panels, shown, strict=False)):
        true = truth[k] if k < len(truth) else np.nan
        _draw_belief(ax, numbers, levels[:, :, k], name, true)
    for ax in panels[len(shown) :]:
        ax.set_axis_off()
    left = len(names) - len(shown)
    upper.suptitle(
        "Belief by trials used: median, central 50 % and 90 %"
        + ("; dashed: truth" if truth else "")
        + (f"; {left} further parameters" if left else ""),
        fontsize=10,
    )
    axes = lower.subplots(1, 3)
    _draw_actions(axes[0], campaign)
    _draw_outcomes(axes[1], campaign, predict(campaign, num_predicted))
    _draw_information(axes[2], campaign.state)
    for ax in axes:
        if ax.get_xlabel() == "trial":
            ax.set_xlim(-0.6, max(len(campaign.state.trials) - 1, 2) + 0.6)
            ax.locator_params(axis="x", integer=True)
    return figure


def predict(campaign: Any, num_simulations: int) -> dict[int, Array]:
    """Return simulations of each executed action, by the index of its trial, (n, q).

    They use the kept draws of the belief before the trial. Where these draws are of
    other parameters, those of an earlier model, there is no prediction.

    Args:
        campaign: Campaign; there are no predictions without its simulator.
        num_simulations: Simulations of each trial; 0 for no predictions.
    """
    state, found = campaign.state, {}
    if campaign.simulator is None or num_simulations == 0:
        return found
    before = _prior_draws(campaign, "shown", num_simulations)
    dim = before.shape[1]
    for index in state.processed:
        trial = state.trials[index]
        if trial.status == "ok" and before.shape[1] == dim:
            theta = before[torch.arange(num_simulations) % len(before)]
            seed = derive_seed(state.seed, "shown", index)
            rows = campaign._learner.outcomes(trial, theta, seed)
            x = rows.without_missing().x.flatten(1).double().numpy()
            if np.isfinite(x).any():
                found[index] = x
        before = state.draws.get(index, before)
    return found


def _prior_draws(campaign: Any, purpose: str, num: int) -> Tensor:
    with forked_generators(derive_seed(campaign.state.seed, purpose)):
        return campaign.prior.sample(torch.Size([num])).reshape(num, -1)


def _quantiles(campaign: Any, dim: int, num: int = 2_000) -> tuple[list[int], Array]:
    """Return numbers of trials, and quantiles of the belief after so many, (n, 5, dim).

    Parameters that an earlier model did not have are NaN.
    """
    state = campaign.state
    draws = {0: _prior_draws(campaign, "draws", num)}
    for number, index in enumerate(state.processed, 1):
        if index in state.draws:
            draws[number] = state.draws[index]
    levels = np.full((len(draws), len(LEVELS), dim), np.nan)
    for row, theta in zip(levels, draws.values(), strict=True):
        known = theta[:, :dim].double().numpy()
        row[:, : known.shape[1]] = np.quantile(known, LEVELS, axis=0)
    return [*draws], levels


def _draw_belief(
    ax: Axes,
    numbers: list[int],
    levels: Array,
    name: str,
    truth: float,
    most_widths: float = 10.0,
) -> None:
    """Draw quantiles of one parameter, within so many widths of the last belief."""
    low, quarter, median, three_quarters, high = levels.T
    ax.fill_between(numbers, low, high, alpha=0.2, color="C0", lw=0)
    ax.fill_between(numbers, quarter, three_quarters, alpha=0.4, color="C0", lw=0)
    ax.plot(numbers, median, "o-", color="C0", ms=3, lw=1)
    ax.axhline(truth, color=TRUTH, ls="--", lw=1)
    far = most_widths * (high[-1] - low[-1])
    bottom = np.fmin(max(np.nanmin(low), low[-1] - far), truth)
    top = np.fmax(min(np.nanmax(high), high[-1] + far), truth)
    room = 0.08 * (top - bottom) or 1e-6 + 0.01 * abs(bottom)
    ax.set_ylim(bottom - room, top + room)
    middle, *ends = within(median[-1], low[-1], high[-1], most=5)
    short = name if len(name) <= 24 else f"{name[:12]}…{name[-11:]}"
    ax.set_title(f"{short}\n{middle} ({' to '.join(ends)})", fontsize=8)
    ax.tick_params(labelsize=8)
    ax.locator_params(axis="x", integer=True)


def _draw_actions(ax: Axes, campaign: Any) -> None:
    """Draw what each action was expected to tell, a line a trial, or the last map."""
    trials, labels = campaign.state.trials, [*campaign.actions.entry_labels]
    designed = [t for t in trials if np.isfinite(t.expected_gain[0])]
    if not designed:
        ax.set_title("actions, which were not designed", fontsize=10)
        ax.set(xlabel="trial", ylabel="; ".join(labels))
        ax.plot([t.index for t in trials], [t.action.tolist() for t in trials], "o")
        return
    if len(labels) > 1:
        plot_design(designed[-1].design, ax)
        ax.set_title(f"information by action, trial {designed[-1].index}", fontsize=10)
        return
    from matplotlib import colormaps

    colors = colormaps["viridis"](np.linspace(0.1, 0.75, len(designed)))
    for trial, color in zip(designed, colors, strict=True):
        design = trial.design
        place, gain = design.candidates[:, 0], design.expected_information_gain
        order = place.argsort()
        ax.plot(place[order], gain[order], "-", color=color, lw=1)
        chosen = place[design.index], gain[design.index]
        label = f"trial {trial.index}" if trial in (designed[0], designed[-1]) else ""
        ax.plot(*chosen, "o", color=color, ms=6, label=label)
    ax.legend(fontsize=8)
    low, high = ax.get_ylim()
    # A bound may be far below zero where nothing is told.
    ax.set_ylim(max(low, -max(high, 1.0)), high)
    ax.set(xlabel=labels[0], ylabel="expected information [nats]")
    ax.set_title("information by action, dots: chosen", fontsize=10)


def _draw_outcomes(
    ax: Axes, campaign: Any, predicted: dict[int, Array], farthest: float = 10.0
) -> None:
    """Draw outcomes with predictions, or where there are none their surprise.

    Args:
        ax: Axes to draw on.
        campaign: The campaign.
        predicted: Simulations from :func:`predict`.
        farthest: Deviations from the prediction at which what is farther is drawn.
    """
    trials = campaign.state.trials
    ax.set_xlabel("trial")
    if not predicted:
        ax.set_title("surprise, uniform where the simulator is right", fontsize=10)
        ax.set(ylim=(-0.03, 1.03), ylabel="tail probability of the outcome")
        known = [(t.index, t.surprise) for t in trials if t.surprise is not None]
        ax.plot(*np.array(known).reshape(-1, 2).T, "o", color="C0")
        return
    ax.set_title("outcome and prediction", fontsize=10)
    for index, rows in predicted.items():
        x = trials[index].x.flatten().double().numpy()
        if len(x) == 1:
            ax.vlines(index, *np.nanquantile(rows, [0.05, 0.95]), color=FAINT, lw=5)
            ax.plot(index, x[0], "o", color="C0", ms=5)
            ax.set_ylabel("outcome (gray: 90 % of the prediction)")
            continue
        sd = np.nanstd(rows, axis=0)
        sd = np.maximum(sd, 1e-9 * max(float(np.nanmax(sd)), 1e-300))
        z = (x - np.nanmean(rows, axis=0)) / sd
        place = index + np.linspace(-0.18, 0.18, len(z))
        ax.plot(
            place, z.clip(-farthest, farthest), "o", color="C0", ms=3, alpha=0.6, mew=0
        )
        ax.set_ylabel(f"outcome less prediction [its sd, up to {farthest:g}]")
        ax.axhline(0.0, color=FAINT, lw=1, zorder=0)


def _draw_information(ax: Axes, state: Any) -> None:
    """Draw what each trial was expected to tell and told, and the sum."""
    used = [t for t in state.trials if t.information_gained is not None]
    index = [t.index for t in used]
    gained = np.array([t.information_gained for t in used], dtype=float)
    colors = [BARS[t.health] for t in used]
    ax.bar(index, gained, color=colors, alpha=0.7, width=0.7, label="gained")
    ax.plot(index, gained.cumsum(), "-", color=FAINT, lw=1.5, label="in all")
    expected = [(t.index, *t.expected_gain) for t in state.trials]
    known = np.array([row for row in expected if np.isfinite(row[1])]).reshape(-1, 3)
    style = {"ecolor": EXPECTED, "color": EXPECTED, "capsize": 2, "ms": 4}
    error = 2 * np.nan_to_num(known[:, 2])
    ax.errorbar(known[:, 0], known[:, 1], error, fmt="D", label="expected", **style)
    ax.legend(fontsize=8)
    worst = [h for h in ("alarm", "watch") if BARS[h] in colors][:1]
    title = f"information by trial, {gained.sum():.3g} nats in all"
    ax.set_title("; ".join([title, *worst]), fontsize=10)
    ax.set(xlabel="trial", ylabel="information [nats]")
