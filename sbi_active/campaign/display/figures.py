"""A campaign as one figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.campaign.health import health_by_trial
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.design.drawing import draw, labels_of
from sbi_active.display.table import within
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

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

    state, parameter_names = campaign.state, campaign.parameter_names
    truth = None if theta_true is None else torch.as_tensor(theta_true).flatten()
    # Without the parameters of effects that were adopted, too.
    if truth is not None and len(truth) > len(parameter_names):
        raise ValueError(
            f"expected theta_true with at most {len(parameter_names)} numbers; got "
            f"{len(truth)}; pass one a parameter"
        )
    shown = parameter_names[:most_parameters]
    columns = min(max(len(shown), 2), 4 if len(shown) <= 12 else 5)
    rows = -(-len(shown) // columns)
    high = 2.0 * rows if rows > 1 else 2.7
    figure: Any = plt.figure(figsize=(12, high + 3.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[high, 3.6])
    panels = upper.subplots(rows, columns, squeeze=False)
    beliefs = _quantiles(state, campaign.prior, len(parameter_names))
    for k, ax in enumerate(panels.flat):
        if k < len(shown):
            value = None if truth is None or k >= len(truth) else float(truth[k])
            _belief(ax, beliefs, k, shown[k], value)
            if k + columns >= len(shown):
                ax.set_xlabel("trials used")
        else:
            ax.set_axis_off()
    left = len(parameter_names) - len(shown)
    upper.suptitle(
        "Belief by round: median, central 50 % and 90 %"
        + ("" if truth is None else "; dashed: truth")
        + (f"; {left} further parameters" if left else ""),
        fontsize=10,
    )
    axes = lower.subplots(1, 3)
    _gain_by_action(axes[0], state)
    _against_prediction(axes[1], predict(campaign, num_predicted), state)
    _information(axes[2], state)
    for ax in axes:
        if ax.get_xlabel() == "trial":
            ax.set_xlim(-0.6, max(len(state.trials) - 1, 2) + 0.6)
            ax.xaxis.get_major_locator().set_params(integer=True)
    return figure


def predict(campaign: Any, num_simulations: int) -> dict[int, Array]:
    """Return simulations of each executed action, by the index of its trial, (n, q).

    They use the kept draws of the belief before the trial. Where these draws are of
    other parameters, those of an earlier model, there is no prediction.

    Args:
        campaign: Campaign; there are no predictions without its simulator.
        num_simulations: Simulations of each trial; 0 for no predictions.
    """
    state, prior = campaign.state, campaign.prior
    if campaign.simulator is None or num_simulations == 0:
        return {}
    with forked_generators(derive_seed(state.seed, "shown")):
        before = prior.sample(torch.Size([num_simulations]))
    before = before.reshape(num_simulations, -1)
    dim, found = before.shape[1], {}
    for index in state.processed:
        trial = state.trials[index]
        if trial.status == "ok" and trial.x is not None and before.shape[1] == dim:
            theta = before[torch.arange(num_simulations) % len(before)]
            rows = simulate(
                campaign._learner.at(index),
                theta,
                trial.action.expand(num_simulations, -1),
                seed=derive_seed(state.seed, "shown", index),
                workers=state.options.workers,
            )
            x = rows.without_missing().x.flatten(1).double().numpy()
            if np.isfinite(x).any():
                found[index] = x
        before = state.draws.get(index, before)
    return found


def _quantiles(
    state: CampaignState, prior: Distribution, dim: int, num: int = 2_000
) -> list[tuple[int, Array]]:
    """Return the quantiles of each belief by the number of trials in it, (5, dim).

    Parameters that an earlier model did not have are NaN.
    """
    with forked_generators(derive_seed(state.seed, "draws")):
        first = prior.sample(torch.Size([num])).reshape(num, -1)
    found = []
    used = [i for i in state.processed if i in state.draws]
    for k, draws in enumerate([first, *(state.draws[i] for i in used)]):
        levels = np.full((len(LEVELS), dim), np.nan)
        size = min(draws.shape[1], dim)
        levels[:, :size] = np.quantile(draws[:, :size].double().numpy(), LEVELS, axis=0)
        number = 0 if k == 0 else state.processed.index(used[k - 1]) + 1
        found.append((number, levels))
    return found


def _belief(
    ax: Axes,
    beliefs: Sequence[tuple[int, Array]],
    k: int,
    name: str,
    truth: float | None,
    least_share: float = 0.05,
) -> None:
    """Draw quantiles of one parameter over the rounds, readable to the last."""
    rounds = np.array([number for number, _ in beliefs])
    levels = np.stack([quantiles[:, k] for _, quantiles in beliefs])
    ax.fill_between(rounds, levels[:, 0], levels[:, 4], alpha=0.2, color="C0", lw=0)
    ax.fill_between(rounds, levels[:, 1], levels[:, 3], alpha=0.4, color="C0", lw=0)
    ax.plot(rounds, levels[:, 2], "o-", color="C0", ms=3, lw=1)
    if truth is not None:
        ax.axhline(truth, color=TRUTH, ls="--", lw=1)
    # From the round on from which the last belief takes its share of the panel.
    low, high, width = levels[:, 0], levels[:, 4], levels[-1, 4] - levels[-1, 0]
    for first in range(len(levels)):
        ends = np.nanmin(low[first:]), np.nanmax(high[first:])
        if width >= least_share * (ends[1] - ends[0]):
            break
    if truth is not None and low[0] <= truth <= high[0]:
        ends = min(ends[0], truth), max(ends[1], truth)
    room = 0.08 * (ends[1] - ends[0]) or 1e-6 + 0.01 * abs(ends[0])
    ax.set_ylim(ends[0] - room, ends[1] + room)
    middle, low, high = within(*levels[-1, [2, 0, 4]].tolist(), most=5)
    shown = name if len(name) <= 24 else f"{name[:12]}…{name[-11:]}"
    ax.set_title(f"{shown}\n{middle} ({low} to {high})", fontsize=8)
    ax.locator_params(axis="y", nbins=5)
    ax.tick_params(labelsize=8)
    ax.locator_params(axis="x", integer=True)


def _gain_by_action(ax: Axes, state: CampaignState) -> None:
    """Draw what each action was expected to tell, a line a round, or the last map."""
    designed = [
        t
        for t in state.trials
        if t.design is not None and t.design.expected_information_gain.isfinite().any()
    ]
    if not designed:
        _actions(ax, state.trials)
        return
    last, last_index = designed[-1].design, designed[-1].index
    assert last is not None
    if last.candidates.shape[1] > 1:
        draw(last, ax)
        ax.set_title(f"information by action, trial {last_index}", fontsize=10)
        return
    from matplotlib import colormaps

    colors = colormaps["viridis"](np.linspace(0, 0.9, len(designed)))
    for trial, color in zip(designed, colors, strict=True):
        design = trial.design
        assert design is not None
        order = design.candidates[:, 0].argsort()
        gain = design.expected_information_gain
        place = design.candidates[:, 0]
        ax.plot(place[order], gain[order], "-", color=color, lw=1)
        ax.plot(place[design.index], gain[design.index], "o", color=color, ms=6)
    ends = {designed[0].index: colors[0], last_index: colors[-1]}
    for trial, color in ends.items():
        ax.plot([], [], "o-", color=color, label=f"trial {trial}")
    ax.legend(fontsize=8)
    low, high = ax.get_ylim()
    # A bound may be far below zero where nothing is told.
    ax.set_ylim(max(low, -max(high, 1.0)), high)
    ax.set(xlabel=labels_of(last)[0], ylabel="expected information [nats]")
    ax.set_title("information by action, dots: chosen", fontsize=10)


def _actions(ax: Axes, trials: Sequence[Trial]) -> None:
    """Draw the actions by trial, where none was designed; several within ranges."""
    ax.set_title("actions, which were not designed", fontsize=10)
    ax.set_xlabel("trial")
    if not trials:
        return
    rows = np.stack([t.action.numpy() for t in trials])
    labels = [f"action {j + 1}" for j in range(rows.shape[1])]
    for trial in trials:
        if trial.design is not None:
            labels = labels_of(trial.design)
    low, high = rows.min(0), rows.max(0)
    scaled = (rows - low) / np.where(high > low, high - low, 1.0)
    several = rows.shape[1] > 1
    index = [t.index for t in trials]
    for j, label in enumerate(labels):
        ax.plot(index, scaled[:, j] if several else rows[:, 0], "o", label=label)
    ax.set_ylabel("share of the range executed" if several else labels[0])
    if 1 < len(labels) <= 8:
        ax.legend(fontsize=8)


def _against_prediction(
    ax: Axes, predicted: dict[int, Array], state: CampaignState
) -> None:
    """Draw outcomes with what the belief before each trial predicted."""
    ax.set_xlabel("trial")
    if not predicted:
        _surprises(ax, state)
        return
    single = next(iter(predicted.values())).shape[1] == 1
    ax.set_title("outcome and prediction", fontsize=10)
    for index, rows in predicted.items():
        x = state.trials[index].x
        assert x is not None
        observed = x.flatten().double().numpy()
        if single:
            low, high = np.nanquantile(rows[:, 0], [0.05, 0.95])
            ax.vlines(index, low, high, color=FAINT, lw=5)
            ax.plot(index, observed[0], "o", color="C0", ms=5)
            continue
        sd = np.nanstd(rows, axis=0)
        floor = 1e-9 * max(float(np.nanmax(sd)), 1e-300)
        z = (observed - np.nanmean(rows, axis=0)) / np.maximum(sd, floor)
        z = z[np.isfinite(z)]
        spread = np.linspace(-0.18, 0.18, len(z)) if len(z) > 1 else np.zeros(len(z))
        small = 4 if len(z) <= 20 else 2
        ax.plot(index + spread, z, "o", color="C0", ms=small, alpha=0.6, mew=0)
    if single:
        ax.set_ylabel("outcome (gray: 90 % of the prediction)")
    else:
        ax.axhspan(-2, 2, color=FAINT, alpha=0.2, lw=0)
        ax.set_ylabel("outcome less prediction [its sd]")
        high = max(3.0, *(abs(v) for v in ax.get_ylim()))
        ax.set_ylim(-high, high)
        if high > 12:
            ax.set_yscale("symlog", linthresh=4)


def _surprises(ax: Axes, state: CampaignState) -> None:
    """Draw the tail probabilities, which rest on simulations of then."""
    known = [t for t in state.trials if t.surprise is not None]
    ax.set_title("surprise, uniform where the simulator is right", fontsize=10)
    surprises = np.array([t.surprise for t in known], dtype=float)
    ax.plot([t.index for t in known], surprises, "o", color="C0")
    ax.set(ylim=(-0.03, 1.03), ylabel="tail probability of the outcome")


def _information(ax: Axes, state: CampaignState) -> None:
    """Draw what each trial was expected to tell and told, and the sum."""
    used = [t for t in state.trials if t.information_gained is not None]
    gained = np.array([t.information_gained for t in used], dtype=float)
    healths = health_by_trial(state)
    colors = [BARS[healths.get(t.index)] for t in used]
    index = [t.index for t in used]
    ax.bar(index, gained, color=colors, alpha=0.7, width=0.7, label="gained")
    expected = [(t.index, *t.expected_gain) for t in state.trials]
    known = np.array([row for row in expected if np.isfinite(row[1])]).reshape(-1, 3)
    if len(known):
        error = 2 * np.nan_to_num(known[:, 2])
        style = {"ecolor": EXPECTED, "color": EXPECTED, "capsize": 2, "ms": 4}
        ax.errorbar(known[:, 0], known[:, 1], error, fmt="D", label="expected", **style)
    if used:
        total = f"information by trial, {gained.sum():.3g} nats in all"
        ax.plot(index, gained.cumsum(), "-", color=FAINT, lw=1.5, label="in all")
        ax.legend(fontsize=8)
    else:
        total = "information by trial"
    worst = [h for h in ("alarm", "watch") if BARS[h] in colors]
    ax.set_title(total + (f"; {', '.join(worst)}" if worst else ""))
    ax.title.set_fontsize(10)
    ax.set(xlabel="trial", ylabel="information [nats]")
