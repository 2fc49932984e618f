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
        rows = [
            (name, f"{mean:.4g}", f"{sd:.2g}", f"{a:.4g} to {b:.4g}")
            for name, mean, sd, a, b in columns
        ]
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
    return "" if value is None or value != value else f"{value:.3g}"


def _lines(header: Sequence[Any], rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    bar = ["---", *["---:"] * (len(header) - 1)]
    for row in (header, bar, *rows):
        cells = [str(cell).replace("|", "\\|") for cell in row]
        yield f"| {' | '.join(cells)} |"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return "" if value is None else f"{value!s:.60}"
