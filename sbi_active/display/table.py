"""A table, and its one way to be text and Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pandas import DataFrame
    from torch import Tensor


@dataclass(frozen=True)
class Table:
    r"""A table; the first column holds words, all others numbers.

    Attributes:
        header: Headings of the columns.
        rows: Cells, shown by :func:`str`.

    Example:
        >>> table = Table(("model", "P"), [("bare", "0.25"), ("drag|lift", "0.75")])
        >>> print(table.text())
        model         P
        ---------  ----
        bare       0.25
        drag|lift  0.75
        >>> print(table.markdown())
        | model | P |
        | --- | ---: |
        | bare | 0.25 |
        | drag\|lift | 0.75 |
    """

    header: Sequence[Any]
    rows: Sequence[Sequence[Any]]

    @classmethod
    def of(cls, frame: DataFrame) -> Table:
        """Return a data frame without its index, and without columns of NaN alone."""
        kept = frame.dropna(axis="columns", how="all")
        rows = kept.itertuples(index=False)
        return cls([*kept.columns], [[*map(_cell, row)] for row in rows])

    @classmethod
    def of_parameters(cls, names: Sequence[str], draws: Tensor) -> Table:
        """Return mean, standard deviation and central 90 % of each parameter.

        Args:
            names: Names of the parameters.
            draws: Draws of a belief, shape (n, theta_dim).
        """
        values = draws.double().numpy()
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
        columns = zip(names, values.mean(0), values.std(0), low, high, strict=True)
        rows = []
        for name, mean, sd, *ends in columns:
            middle, a, b = within(mean, *ends)
            rows.append((name, middle, f"{sd:.2g}", f"{a} to {b}"))
        return cls(("parameter", "mean", "sd", "central 90 %"), rows)

    def text(self) -> str:
        """Return aligned columns, with a rule under the header."""
        cells = [[*map(str, row)] for row in (self.header, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        cells.insert(1, ["-" * width for width in widths])
        return "\n".join(
            "  ".join(
                cell.rjust(width) if k else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in cells
        )

    def markdown(self) -> str:
        """Return a table of Markdown."""
        return "\n".join(_lines(self.header, self.rows))


def number(value: float | None) -> str:
    """Return a number in a few digits, "" for none."""
    if value is None or value != value:
        return ""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def within(
    middle: float, low: float, high: float, *, most: int = 7
) -> tuple[str, str, str]:
    """Return a number and its interval in digits that tell the three apart.

    Args:
        middle: Number within the interval.
        low: Lower end.
        high: Upper end.
        most: Digits at most, where there is little room.

    Example:
        >>> within(0.3, 0.1, 0.6), within(273.152, 273.13, 273.17)
        (('0.3', '0.1', '0.6'), ('273.152', '273.13', '273.17'))
    """
    digits, width = 4, high - low
    if np.isfinite(middle) and width > 0:
        ratio = max(abs(middle) / width, 1e-9)
        digits = int(np.clip(np.ceil(np.log10(ratio)) + 2, 4, most))
    middle_text, *ends = (f"{v:.{digits}g}" for v in (middle, low, high))
    return middle_text, ends[0], ends[1]


def _lines(header: Sequence[Any], rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    bar = ["---", *["---:"] * (len(header) - 1)]
    for row in (header, bar, *rows):
        cells = [str(cell).replace("|", "\\|") for cell in row]
        yield f"| {' | '.join(cells)} |"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    if isinstance(value, tuple):
        return " to ".join(map(_cell, value))
    return "" if value is None else f"{value!s:.60}"
