r"""A reference posterior of whole campaigns, from many pours around the truth.

    python -m benchmarks pouring.around --bank FOLDER --target 1 --rows 200
    python -m benchmarks pouring.around --summary

How far is the belief of a campaign from what its images can tell? Around the final
beliefs of a target's campaigns, in a box that holds nearly all of them, parameters are
drawn uniformly and poured at every action that these campaigns chose: per volume of the
prior, ten to thirty times as many pours as the bank that the belief was learned from.
The reference learns a likelihood of each action from them and from both summaries at
once (``likelihood``), multiplies it over a campaign's trials, and takes the product to
the one power that tells left-out parameters best; nothing else tempers it.

Both are judged within the box, of which the prior is uniform: at the truth, by the
campaign's own images, and on parameters whose pours the reference did not learn from,
where the mean difference of

.. math:: \log p(\theta^* | x_1, \ldots, x_k)

has an error. Resumable; one row a campaign, in ``results/around.csv``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.special import logsumexp
from torch import Tensor

from benchmarks.pouring.campaign import GridBelief
from benchmarks.pouring.learned import best_power, told_by
from benchmarks.pouring.reference import (
    Campaign,
    Reference,
    ReferenceSettings,
    belief_of,
    run,
)
from benchmarks.rows import column, grouped
from sbi_active.display.table import Table

NUM_FOLDS = 5
NUM_JUDGED = 60  # parameters on which both are judged, a campaign


def density(log_p: np.ndarray, place: int, volume: float) -> float:
    """Return the log density of a cell, where cells fill a volume of the prior."""
    return float(log_p[place] - logsumexp(log_p) + np.log(len(log_p) / volume))


def nearest(cells: np.ndarray, theta: np.ndarray) -> int:
    """Return which cell's middle is nearest to theta (3,)."""
    return int(((cells - theta) ** 2).sum(1).argmin())


def densities(
    log_p: np.ndarray, power: float, at: np.ndarray, volume: float
) -> np.ndarray:
    """Return log densities of cells to a power, one a row, shape (n,)."""
    pairs = zip(power * log_p, at, strict=True)
    return np.array([density(row, place, volume) for row, place in pairs])


def of_bank(
    known: Reference, own: Campaign, images: list[Tensor], theta: np.ndarray
) -> float:
    """Return the log density within the box that the campaign's own belief has."""
    middles = GridBelief.middles().double().numpy()
    inside = known.box.holds(middles)
    log_p = belief_of(known.learned, own, images).log_density.numpy()[inside]
    return density(log_p, nearest(middles[inside], theta), known.box.volume)


def row_of(own: Campaign, known: Reference) -> dict[str, object]:
    """Return a campaign's row."""
    learned, box, pours, task = known.learned, known.box, known.pours, known.task
    cells, middles = box.cells(), GridBelief.middles().double().numpy()
    few = own.once()
    theta = pours[few.places[0]].theta
    judged = np.arange(min(NUM_JUDGED, len(theta)))
    log_p = np.zeros((len(judged), len(cells)))
    for fold in range(NUM_FOLDS):
        out = judged % NUM_FOLDS == fold
        rest = np.setdiff1d(np.arange(len(theta)), judged[out])
        for place in few.places:
            fitted = pours[place].learn(rest)
            log_p[out] += fitted.at(cells, pours[place].images[judged[out]])
    at = np.array([nearest(cells, one) for one in theta[judged]])
    true = log_p[np.arange(len(judged)), at]
    power = best_power(log_p, true)
    _, mass = told_by(power * log_p, power * true)
    reference = densities(log_p, power, at, box.volume)
    ours = [
        of_bank(known, few, [pours[p].images[i] for p in few.places], theta[i])
        for i in judged
    ]
    images, truth = own.images(task, learned.actions), task.theta_true.double().numpy()
    belief = belief_of(learned, own, images).log_density.numpy()
    everything = np.arange(len(theta))
    by_place = {place: pours[place].learn(everything) for place in few.places}
    pairs = zip(own.places, images, strict=True)
    whole = np.sum([by_place[p].at(cells, image[None]) for p, image in pairs], 0)
    gap = reference - np.array(ours)
    return {
        "num_pours": len(theta),
        "volume": box.volume,
        "inside": float(np.exp(belief)[box.holds(middles)].sum() / len(belief)),
        "power": power,
        "ours": of_bank(known, own, images, truth),
        "reference": density(power * whole[0], nearest(cells, truth), box.volume),
        "left_out_ours": np.mean(ours),
        "left_out_reference": np.mean(reference),
        "left_out_se": gap.std(ddof=1) / np.sqrt(len(gap)),
        "num_left_out": len(gap),
        "in_half": float((mass <= 0.5).mean()),
        "in_most": float((mass <= 0.9).mean()),
    }


def by_target(rows: list[dict[str, str]]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each target with its columns."""
    for (target,), own in sorted(grouped(rows, "target").items()):
        yield target, {k: column(own, k) for k in own[0]}


def summarize(rows: list[dict[str, str]]) -> str:
    """Return one line a target."""
    table = []
    for target, value in by_target(rows):
        gap = value["left_out_reference"] - value["left_out_ours"]
        at_truth, num = value["reference"] - value["ours"], len(value["ours"])
        error = np.sqrt((value["left_out_se"] ** 2).mean() / num)
        medians = (value["ours"], value["reference"], at_truth)
        table.append(
            [
                *(target, num, *(f"{np.median(v):.2f}" for v in medians)),
                f"{gap.mean():.2f} +- {error:.2f}",
                f"{value['in_half'].mean():.2f}, {value['in_most'].mean():.2f}",
                f"{value['num_pours'][0]:.0f} in {value['volume'][0]:.3f}",
            ]
        )
    header = ["target", "campaigns", "log p(truth), ours", "reference", "gap, median"]
    header += ["gap on left-out parameters", "reference: in 50 %, 90 %"]
    return Table([*header, "pours an action, volume"], table).text()


def main(arguments: ReferenceSettings) -> None:
    """Run what is asked for and is not there yet, and print the table."""
    run(arguments, "around.csv", row_of, summarize)
