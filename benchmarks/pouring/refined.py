r"""A campaign's belief refined by pours around it, beside the reference.

    python -m benchmarks pouring.refined --bank FOLDER --target 2 --pours 100
    python -m benchmarks pouring.refined --summary

After its last round a campaign pours parameters drawn uniformly in a box about its own
belief, 100 at each action that it chose, and learns the likelihoods of these actions
anew, from these and the bank's pours of the action, by both summaries of each image at
once. The product over its trials is taken to the power that tells best of pours in its
box that were left out.

It is judged as ``around`` judges, in that box and on those pours (which are made there
first): by the truth and the campaign's own images, and on parameters from which neither
the reference nor the refinement learned, those within the campaign's own box.
Resumable; one row a campaign, in ``results/refined.csv``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.pouring.around import (
    NUM_JUDGED,
    by_target,
    densities,
    density,
    nearest,
    of_bank,
)
from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.bank import read_parts
from benchmarks.pouring.learned import PARTS, best_power
from benchmarks.pouring.reference import (
    Campaign,
    Pours,
    Reference,
    ReferenceSettings,
    at_action,
    belief_of,
    box_around,
    pour_around,
    run,
)
from sbi_active.display.table import Table

NUM_FOLDS = 3


def joined(first: Pours, second: Pours) -> Pours:
    """Return the pours of both."""
    theta = np.concatenate([first.theta, second.theta])
    return Pours(theta, torch.cat([first.images, second.images]))


def power_of(fresh: list[Pours], others: list[Pours], cells: np.ndarray) -> float:
    """Return the power of a product over actions that tells left-out pours best.

    Args:
        fresh: Pours of the same parameters at each action.
        others: More pours at each.
        cells: Of the box that the parameters are from, shape (m, 3).
    """
    theta = fresh[0].theta
    log_p = np.zeros((len(theta), len(cells)))
    for fold in range(NUM_FOLDS):
        out = np.arange(len(theta)) % NUM_FOLDS == fold
        for pours, more in zip(fresh, others, strict=True):
            both = joined(pours, more)
            among = np.nonzero(~np.concatenate([out, np.zeros(len(more.theta), bool)]))
            log_p[out] += both.learn(among[0]).at(cells, pours.images[out])
    at = np.array([nearest(cells, one) for one in theta])
    return best_power(log_p, log_p[np.arange(len(theta)), at])


def row_of(own: Campaign, judge: Reference, bank: Path, num: int) -> dict[str, object]:
    """Return a campaign's row.

    Args:
        own: The campaign.
        judge: What it is judged by.
        bank: Folder of pours.
        num: Number of fresh pours an action.
    """
    learned, box, task, known = judge.learned, judge.box, judge.task, judge.pours
    images, alone = own.images(task, learned.actions), own.once()
    narrow, places = box_around([belief_of(learned, own, images)]), alone.places
    part = f"{task.target}_{own.seed}"
    fresh = pour_around(bank, part, narrow, learned.actions[places], num, task)
    spent = read_bank(bank, f"around_{part}").cpu_seconds
    stored = read_parts(bank, PARTS)
    theta, cells = known[places[0]].theta, box.cells()
    judged = np.nonzero(narrow.holds(theta[:NUM_JUDGED]))[0]
    rest = np.arange(NUM_JUDGED, len(theta))
    by_bank_too = [at_action(stored, learned.actions[p], task) for p in places]
    refined_power = power_of(fresh, by_bank_too, narrow.cells())
    refined, reference, left_refined, left_reference = (
        np.zeros((n, len(cells))) for n in (1, 1, len(judged), len(judged))
    )
    for place, pours, others in zip(places, fresh, by_bank_too, strict=True):
        both = joined(pours, others)
        mine = both.learn(np.arange(len(both.theta)))
        other = known[place].learn(rest)
        seen = torch.stack(
            [im for im, p in zip(images, own.places, strict=True) if p == place]
        )
        refined += mine.at(cells, seen).sum(0)
        reference += other.at(cells, seen).sum(0)
        left_refined += mine.at(cells, known[place].images[judged])
        left_reference += other.at(cells, known[place].images[judged])
    at = np.array([nearest(cells, theta[i]) for i in judged])
    power = best_power(left_reference, left_reference[np.arange(len(at)), at])
    truth = task.theta_true.double().numpy()
    place = nearest(cells, truth)
    told = densities(left_refined, refined_power, at, box.volume)
    told_reference = densities(left_reference, power, at, box.volume)
    bank_told = [
        of_bank(judge, alone, [known[p].images[i] for p in places], theta[i])
        for i in judged
    ]
    gap = told_reference - told
    return {
        "num_pours": sum(len(pours.theta) for pours in fresh),
        "cpu_pours": spent,
        "power": refined_power,
        "ours": of_bank(judge, own, images, truth),
        "refined": density(refined_power * refined[0], place, box.volume),
        "reference": density(power * reference[0], place, box.volume),
        "left_out_ours": float(np.mean(bank_told)),
        "left_out_refined": float(told.mean()),
        "left_out_reference": float(told_reference.mean()),
        "gap": float(gap.mean()),
        "gap_se": float(gap.std(ddof=1) / np.sqrt(len(gap))),
        "num_left_out": len(gap),
    }


def summarize(rows: list[dict[str, str]]) -> str:
    """Return one line a target."""
    table = []
    for target, value in by_target(rows):
        names, num = ("ours", "refined", "reference"), len(value["ours"])
        error = np.sqrt((value["gap_se"] ** 2).mean() / num)
        table.append(
            [
                *(target, num),
                " / ".join(f"{np.median(value[k]):.2f}" for k in names),
                " / ".join(f"{value[f'left_out_{k}'].mean():.2f}" for k in names),
                f"{value['gap'].mean():.2f} +- {error:.2f}",
                f"{value['num_left_out'].sum():.0f}",
                f"{value['num_pours'].mean():.0f}, {value['cpu_pours'].mean():.0f}",
            ]
        )
    header = ["target", "campaigns", "log p(truth): bank / refined / reference"]
    header += ["on left-out parameters", "gap of the refined", "left out"]
    return Table([*header, "pours, CPU s"], table).text()


@dataclass(frozen=True)
class Settings(ReferenceSettings):
    """What is run.

    Args:
        pours: Number of pours an action.
        trials: Number of trials.
    """

    trials: int | None = 5
    pours: int = 100


def main(arguments: Settings) -> None:
    """Run what is asked for and is not there yet, and print the table."""

    def made(own: Campaign, known: Reference) -> dict[str, object]:
        assert arguments.bank is not None
        return row_of(own, known, arguments.bank, arguments.pours)

    run(arguments, "refined.csv", made, summarize)
