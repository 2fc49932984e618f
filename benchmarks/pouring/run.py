"""The paper's Figures 11 and 12: log p(truth) and selected actions by round.

    python -m benchmarks pouring --bank FOLDER                  # both targets
    python -m benchmarks pouring --bank FOLDER --target prior --method asbi
    python -m benchmarks pouring --summary

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method and target, in ``benchmarks/pouring/results``.

Algorithm 1 on 100 cubes. A campaign simulates nothing but its trials: the likelihood of
each action and summary is learned once from a bank of pours from the prior
(``likelihood``), a belief is the tempered product of its trials' on a grid, the action
(h, p, v, delta) chosen by the expected information gain under the same likelihoods.
NSBI has the same belief and random actions. ALHI and NLHI have one neural likelihood a
summary in their place (``network``).

The paper's Figure 12 and the selected actions from the rows of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import rounds
from benchmarks.pouring import campaign
from benchmarks.pouring.learned import ByAction, learn
from benchmarks.pouring.network import ByNetwork, learn_networks
from benchmarks.rows import benchmark, column, published
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task

#: Section 5.4, read from the text: medians of ASBI after the first and last rounds.
PUBLISHED = published("pouring")


def summarize(cells: rounds.Cells) -> str:
    """Return all tables, the paper's figures beside ours.

    Args:
        cells: Rows by method and target.
    """
    log_p, chosen = [], []
    for (method, target), rows in cells.items():
        log_probs = rounds.by_round(rows, "log_prob_true")
        label = f"target {target}, {method.upper()}"
        last = log_probs[-1]
        seconds = sum(
            np.array([float(r[f"cpu_{part}"]) for r in rows]).mean()
            for part in ("design", "trial")
        )
        log_p.append(
            [
                label,
                str(len(last)),
                " / ".join(f"{np.median(v):.2f}" for v in log_probs),
                f"{last.min():.2f} .. {last.max():.2f}",
                *PUBLISHED.get(f"{method} {target}", "-"),
                f"{rounds.by_round(rows, 'power')[-1].mean():.2f}".replace("nan", "-"),
                f"{seconds:.0f}",
            ]
        )
        low = [(v == 20).mean() for v in rounds.by_round(rows, "height")]
        mesh = [v.mean() for v in rounds.by_round(rows, "delta")]
        both = (rounds.by_round(rows, name) for name in ("eig_mesh", "eig_pca"))
        common = [np.mean(one - other) for one, other in zip(*both, strict=True)]
        chosen.append(
            [
                label,
                " / ".join(f"{v:.2f}" for v in low),
                " / ".join(f"{v:.2f}" for v in mesh),
                "-"
                if np.isnan(common).any()
                else " / ".join(f"{v:+.2f}" for v in common),
            ]
        )
    first = Table(
        ["", "trials", "median log p(truth) by round", "last: min .. max"]
        + ["paper (1,000 cubes)", "mean power", "CPU s a round"],
        log_p,
    ).text()
    second = Table(
        ["", "share at h = 20 cm", "share by mesh coverage", "gain: mesh less PCA"],
        chosen,
    ).text()
    shares = [actions_table(cells[key], key[1]) for key in cells if key[0] == "asbi"]
    return "\n\n".join([first, second, *shares, *rounds.active_against_random(cells)])


def label(row: Mapping[str, str]) -> str:
    """Return an action in words."""
    numbers = (float(row[k]) for k in ("height", "position", "rate"))
    summary = "mesh" if int(row["delta"]) else "PCA"
    return ", ".join(f"{v:g}" for v in numbers) + f", {summary}"


def actions_table(rows: rounds.Rows, target: str) -> str:
    """Return the share of trials at each action that was chosen, round by round."""
    numbers = sorted({int(r["round"]) for r in rows})
    table = []
    for name in sorted({label(r) for r in rows}):
        share = [
            np.mean([label(r) == name for r in rows if int(r["round"]) == number])
            for number in numbers
        ]
        table.append([name, " / ".join(f"{v:.1f}" for v in share)])
    head = f"target {target}: h cm, p cm, v rad/s, summary"
    return Table([head, "share of ASBI's trials by round"], table).text()


def mean_log_p(rows: rounds.Rows, number: int) -> str:
    """Return the mean log p(truth) of a round."""
    return f"{column(rows, 'log_prob_true', number).mean():.2f}"


METHODS = ("asbi", "nsbi", "alhi", "nlhi")
ACTIVE, BY_NETWORK = ("asbi", "alhi"), ("alhi", "nlhi")


def rows_of(
    method: str, target: str, seed: int, *, bank: Path | None
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    task, learned = make_task(target, seed), known(method in BY_NETWORK, bank)
    rows: list[dict[str, object]] = []
    for found in campaign.rounds(
        *(task, learned, lambda log_p: campaign.GridBelief(torch.from_numpy(log_p))),
        campaign.GridBelief.middles().double().numpy(),
        num=3 if target == "prior" else 6,
        seed=seed,
        is_active=method in ACTIVE,
        tempered=campaign.TEMPERED if isinstance(learned, ByAction) else 0.0,
    ):
        with forked_generators(derive_seed(seed, "draws", found.index)):
            draws = found.belief.sample(torch.Size([rounds.NUM_DRAWS]))
        row = found.row() | rounds.known_truth(found.belief, task.theta_true, draws)
        row |= {
            "eig_pca": float(found.gain[0].max()),
            "eig_mesh": float(found.gain[1].max()),
            "power": np.nan,
        }
        if isinstance(learned, ByAction):
            row["power"] = learned.learned[found.delta][found.place].likelihood.power
        rows.append(row)
    return rows


@cache
def known(is_network: bool, bank: Path | None) -> ByAction | ByNetwork:
    """Return what is learned of the bank."""
    if bank is None:
        raise SystemExit("expected --bank FOLDER; got none; make one, see bank.py")
    return learn_networks(bank) if is_network else learn(bank, get_task("pouring"))


def make_task(target: str, seed: int) -> Any:
    """Return a target of the paper, or a truth drawn from the prior."""
    if target != "prior":
        return get_task("pouring", target=int(target))
    return rounds.drawn_truth(get_task("pouring"), seed)


def table(rows: rounds.Rows) -> str:
    """Return the tables of the paper's targets, or how often regions hold truths."""
    drawn = rounds.cells_of([row for row in rows if row["target"] == "prior"])
    cells = rounds.cells_of([row for row in rows if row["target"] != "prior"])
    parts = [summarize(cells)] if cells else []
    if drawn:
        numbers = range(1, 1 + max(map(rounds.num_rounds, drawn.values())))
        parts.append(rounds.coverage_table(drawn, numbers, ("mean log p", mean_log_p)))
    return "\n\n".join(parts) or "no trials yet"


main = benchmark(
    Path(__file__).parent / "results" / "target_{target}_{method}.csv",
    rows_of,
    table,
    given={"bank": "Folder of pours; needed for all but the summary."},
    default={"target": ("1", "2")},
    method=METHODS,
    target=("1", "2", "prior"),
    seed=range(2_200, 2_205),
)
