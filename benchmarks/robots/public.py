"""Ten robots that others published, and how each is driven, started and read.

Five ship with dm_control and three with gymnasium, which need not run: their MJCFs are
read. The Go2's leg is that of :mod:`.machines`; the servo is a position-controlled
motor with a weight of .49 kg on .1 m, as in the measured records of one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.robots.machines import spec_of
from benchmarks.rows import toml


@dataclass(frozen=True)
class Public:
    """A robot, and how trials of it are run.

    Attributes:
        mjcf: Its MJCF, as :func:`.spec_of` takes it.
        parameters: What is unknown, as ``from_mjcf`` takes it.
        read: Joints that are read, each with its sensor's deviation, rad or m.
        drive: Amplitude and center of the control, by actuator.
        start: Center and half width of the start, by joint.
        seconds: Length of a trial.
    """

    mjcf: str
    parameters: dict[str, tuple[float, float]]
    read: dict[str, float]
    drive: dict[str, tuple[float, float]]
    start: dict[str, tuple[float, float]]
    seconds: float

    def spec(self) -> Any:
        """Return an ``MjSpec``."""
        return spec_of(self.mjcf)


ROWS = toml(Path(__file__).with_suffix(".toml"))
PUBLIC = {name: Public(**row) for name, row in ROWS.items()}
