"""Report on a simulator before a campaign."""

from __future__ import annotations

from dataclasses import dataclass, field

from sbi_active.identifiability.undetermined import Undetermined
from sbi_active.messages import Message


@dataclass(frozen=True, kw_only=True)
class SimulatorReport:
    """Findings about a simulator; ``print`` shows them.

    Attributes:
        num_rows: Rows that each check simulated.
        x_shape: Shape of one outcome; None if there was none.
        takes_seeds: Whether it is given one seed a row.
        is_deterministic: Whether two seeds gave identical x.
        is_reproducible: Whether one seed gave the same x twice.
        rows_are_independent: Whether rows permuted with their seeds give permuted x;
            None for a simulator without seeds.
        counts: Rows by outcome.
        idle_parameters: Parameters that change nothing.
        idle_actions: Entries of the action that change nothing.
        undetermined: Parameters that no permitted action tells apart, as far as was
            tried, and the combinations of them that actions do determine.
        seconds: Time of ``num_rows`` rows at once.
        num_simulations: Simulations that a campaign needs.
        num_workers: Workers that share them.
        noiseless: Numbers of x, flattened, that two seeds leave as they are while
            others change.
        defects: Defects that keep a campaign from working.
        warnings: Warnings of what deserves a look.
    """

    num_rows: int = 0
    x_shape: tuple[int, ...] | None = None
    takes_seeds: bool = False
    is_deterministic: bool | None = None
    is_reproducible: bool | None = None
    rows_are_independent: bool | None = None
    counts: dict[str, int] = field(default_factory=dict)
    idle_parameters: tuple[str, ...] = ()
    idle_actions: tuple[str, ...] = ()
    undetermined: tuple[Undetermined, ...] = ()
    seconds: float | None = None
    num_simulations: int | None = None
    num_workers: int = 1
    noiseless: tuple[int, ...] = ()
    defects: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("defects", "warnings"):
            object.__setattr__(self, name, tuple(map(Message, getattr(self, name))))

    @property
    def is_ready(self) -> bool:
        """Whether nothing was found that keeps a campaign from working."""
        return not self.defects

    @property
    def minutes(self) -> float | None:
        """Time of a campaign's simulations, which workers share evenly."""
        if self.seconds is None or self.num_simulations is None:
            return None
        seconds = self.num_simulations * self.seconds / self.num_rows
        return seconds / self.num_workers / 60

    def __str__(self) -> str:
        lines = []
        if self.x_shape is not None:
            none = "no argument for them; one is set for each 256 rows"
            counts = ", ".join(f"{n} {name}" for name, n in self.counts.items())
            lines += [
                f"x: shape (n, {', '.join(map(str, self.x_shape))})",
                f"seeds: {'one a row' if self.takes_seeds else none}",
                f"rows: {counts}",
                f"time: {1e3 * (self.seconds or 0.0):.3g} ms for {self.num_rows} rows",
            ]
        if self.minutes is not None:
            workers = f"{self.num_workers} worker{'s' * (self.num_workers > 1)}"
            lines.append(
                f"campaign: at most {self.num_simulations:,} simulations, about "
                f"{_duration(self.minutes)} on {workers} for them, and some to learn"
            )
        lines += [f"warning: {text}" for text in self.warnings]
        lines += [f"defect: {text}" for text in self.defects]
        lines.append("ready" if self.is_ready else "not ready")
        return "\n".join(lines)

    __repr__ = __str__


def _duration(minutes: float) -> str:
    if minutes < 1:
        return f"{60 * minutes:.2g} seconds"
    return f"{minutes:.0f} minutes" if minutes < 120 else f"{minutes / 60:.1f} hours"
