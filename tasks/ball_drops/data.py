"""The measured drops."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.criticism import Trials

__all__ = ["Drop", "read_drops", "trials_of"]

Array = NDArray[Any]

COLUMNS = ("ball", "drop", "time_s", "height_m")
#: Area a mass of a volleyball by the rules of the game (66 cm, 270 g), m^2/kg; the
#: source does not give it.
VOLLEYBALL = 0.66**2 / (4 * np.pi * 0.27)


@dataclass(frozen=True)
class Drop:
    """One measured fall.

    Attributes:
        ball: Its name.
        drop: 1 or 2.
        times: In s, shape (k,).
        heights: In m, shape (k,).
        area_per_mass: Of the ball, m^2/kg.
    """

    ball: str
    drop: int
    times: Array
    heights: Array
    area_per_mass: float


def read_drops(directory: str | Path) -> list[Drop]:
    """Return the drops of ``drops.csv`` and ``balls.csv`` in a folder.

    Args:
        directory: With columns ball, drop, time_s, height_m in the first file and
            ball, mass_kg, circumference_m in the second.

    Raises:
        FileNotFoundError: If a file is not there.
        ValueError: If a column is not there.

    References:
        de Silva et al., Discovery of physics from data: universal laws and
        discrepancies, Frontiers in Artificial Intelligence 3:25 (2020).
    """
    directory = Path(directory)
    tables = []
    for name in ("drops.csv", "balls.csv"):
        path = directory / name
        if not path.is_file():
            raise FileNotFoundError(
                f"expected the measured drops in {directory}; got no {name} there; "
                "give the folder that holds drops.csv and balls.csv"
            )
        tables.append(pd.read_csv(path))
    drops, balls = tables
    missing = [c for c in COLUMNS if c not in drops]
    if missing:
        raise ValueError(
            f"expected columns {', '.join(COLUMNS)} in {directory / 'drops.csv'}; got "
            f"none named {', '.join(missing)}; name them so"
        )
    sizes = balls.set_index("ball")
    area = sizes["circumference_m"] ** 2 / (4 * np.pi * sizes["mass_kg"])
    found = []
    for (ball, drop), rows in drops.groupby(["ball", "drop"], sort=False):
        ratio = float(area.get(ball, np.nan))
        found.append(
            Drop(
                str(ball),
                int(drop),  # type: ignore[arg-type]
                rows["time_s"].to_numpy(float),
                rows["height_m"].to_numpy(float),
                VOLLEYBALL if np.isnan(ratio) else ratio,
            )
        )
    return found


def trials_of(drops: list[Drop], *, until: dict[int, float] | None = None) -> Trials:
    """Return drops as trials, whose action is the ball's area a mass.

    Args:
        drops: One a trial.
        until: By position, the time in s from which on a drop counts as not measured.
    """
    heights = [drop.heights.copy() for drop in drops]
    for i, end in (until or {}).items():
        heights[i][drops[i].times > end] = np.nan
    return Trials(
        [[drop.area_per_mass] for drop in drops],
        heights,
        sample_times=[drop.times for drop in drops],
        channel_labels=["height [m]"],
    )
