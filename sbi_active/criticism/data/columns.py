"""Roles of the columns of a table, and their units, which are converted to SI.

A unit stands in brackets, as in "height [mm]", that of the time also at the end of its
name, as in "time_ms". What is no scale of an SI unit, such as "px", has no factor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sbi_active.expected import did_you_mean, require

TIME = "time"
SCALES = {"": 1.0, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9}
BASES = {b: b for b in ("m", "s", "N", "V", "A", "W", "J", "Hz", "Pa", "rad")}
#: Factor and SI unit of each word; "g" and "mg" are masses or accelerations, and not
#: among them.
WORDS = {p + b: (f, s) for p, f in SCALES.items() for b, s in BASES.items()} | {
    **{f"{p}Nm": (f, "N m") for p, f in SCALES.items()},
    **dict.fromkeys(("deg", "°", "degree", "degrees"), (math.pi / 180, "rad")),
    **dict.fromkeys(("rev", "turn", "turns"), (2 * math.pi, "rad")),
    "rpm": (math.pi / 30, "rad/s"),
    "kg": (1.0, "kg"),
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
}
_TOKEN = re.compile(
    r"(?P<word>[^\W\d_²³]+|°)(?P<power>(?:\^|\*\*)?[-+]?\d+|[²³]|)|/|[\s*·]+|1(?=/)"
)


def to_si(unit: str) -> tuple[float, str] | None:
    """Return the factor to a unit in SI, and that unit; None if it is not known.

    Example:
        >>> to_si("mm/s^2"), to_si("N m s/rad"), to_si("px")
        ((0.001, 'm/s^2'), (1.0, 'N m s/rad'), None)
        >>> to_si("deg/s")
        (0.0174..., 'rad/s')
    """
    factor, sign, text = 1.0, 1, ""
    tokens = [*_TOKEN.finditer(unit)]
    words = [token["word"] for token in tokens if token["word"]]
    if _TOKEN.sub("", unit) or not {*words} <= WORDS.keys():
        return None
    for token in tokens:
        if token["word"] is None:
            sign = -1 if token.group() == "/" else sign
            text += token.group()
            continue
        scale, si = WORDS[token["word"]]
        power = token["power"].replace("²", "2").replace("³", "3").lstrip("^*") or "1"
        factor *= scale ** (sign * int(power))
        text += si + token["power"]
    return factor, text


def split(column: str) -> tuple[str, str]:
    """Return the name in a column or a label, and the unit; "" if there is none.

    Example:
        >>> split("angle [deg]"), split("x_height")
        (('angle', 'deg'), ('x_height', ''))
    """
    match = re.fullmatch(r"(.*?)\s*\[(.*)\]\s*", column)
    return (column, "") if match is None else (match[1], match[2].strip())


def time_unit(column: str) -> str:
    """Return the unit of time at the end of a column's name, "" if there is none."""
    end = column.rpartition("_")[2]
    return end if end and (to_si(end) or ("", ""))[1] == "s" else ""


TRIAL = "trial"
#: Roles that several columns may have, whose names begin with it, as in "x_height".
SEVERAL = ("action", "x", "input", "start")
OPTIONAL = ("role", "index", "repeat_of")
KEYS = (TRIAL, TIME, *SEVERAL, *OPTIONAL)

#: Names of columns by what they are, where they have names of their own.
Told = Mapping[str, str | Sequence[str]]
Units = Mapping[str, str]  # by column


@dataclass(frozen=True)
class Column:
    """A column of a table, in SI where its unit is known.

    Attributes:
        role: Role of its cells, one of :data:`KEYS`.
        header: Name of the column in the table.
        name: Name without the role and the unit.
        unit: Unit of its numbers; "" if none was said.
        factor: Factor from the table's numbers to that unit.
    """

    role: str
    header: str
    name: str
    unit: str = ""
    factor: float = 1.0

    @property
    def label(self) -> str:
        """Name and unit, as in "speed [m/s]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def find_columns(
    headers: Sequence[str], columns: Told | None, units: Units | None, source: str
) -> list[Column]:
    """Return the columns of a table, by their names or as the user says.

    Args:
        headers: Names of all columns.
        columns: Names of those that are "trial", "time", "action", "x", "input",
            "start", "role", "index" or "repeat_of"; others are then ignored. None goes
            by the names.
        units: Units by column, with or without what stands in its brackets.
        source: Name of the table in messages.

    Raises:
        ValueError: If a column is unknown or there twice, or has two units.
    """
    told = [(_role_of(split(header)[0]), header) for header in headers]
    if columns is None:
        unknown = ", ".join(header for role, header in told if not role)
        # A table in which nothing has such a name is said to lack those.
        known = {role for role, _ in told}
        is_understood = "input" in known or {"action", "x"} <= known
        advice = "rename or remove what is none of these, or say which are what by "
        advice += "columns= (--columns x=NAME)"
        got, is_known = f"{unknown} in {source}", not (unknown and is_understood)
        require(is_known, f"columns {_in_words(KEYS)}", got, advice)
        told = [(role, header) for role, header in told if role]
    else:
        of = {split(name)[0]: name for name in headers} | {
            name: name for name in headers
        }
        told = [(role, of[name]) for role, name in pairs(columns) if name in of]
    for role in (TIME, *OPTIONAL):
        every = [header for own, header in told if own == role]
        got = f"{', '.join(every)} in {source}"
        require(len(every) <= 1, f"one column for {role}", got, "keep one")
    for _, header in told:
        same = [each for each in headers if split(each)[0] == split(header)[0]]
        got = f"{' and '.join(same)} in {source}"
        require(len(same) == 1, "each quantity once", got, "remove or rename one")
    return [_column(role, header, units or {}, source) for role, header in told]


def pairs(columns: Told) -> list[tuple[str, str]]:
    """Return the role and the name of each column that a user names.

    Raises:
        ValueError: If a role is none.
    """
    for role in columns:
        expected = f"columns of {', '.join(KEYS)}"
        require(role in KEYS, expected, role, "say which columns are these")
    each = {role: [n] if isinstance(n, str) else n for role, n in columns.items()}
    return [(role, name) for role, names in each.items() for name in names]


def require_named(names: Iterable[str], headers: Sequence[str], source: str) -> None:
    """Raise if no column has a name, with or without what stands in brackets."""
    known = {*headers} | {split(header)[0] for header in headers}
    for name in names:
        got = f"{', '.join(headers)} in {source}"
        advice = did_you_mean(name, headers, "correct the name")
        require(name in known, f"a column {name}", got, advice)


def require_columns(
    found: Sequence[Column], needed: Sequence[str], source: str
) -> None:
    """Raise if a table lacks columns.

    Args:
        found: Columns of the table.
        needed: Roles that it needs.
        source: Name of the table in messages.
    """
    headers = ", ".join(column.header for column in found)
    require(
        {*needed} <= {column.role for column in found},
        f"columns {_in_words(needed)}",
        f"{headers or 'none of these'} in {source}",
        "name them, as in action_speed, x_distance[m] (action_none, of ones, where "
        "nothing was set), input_voltage[V] where it varies in time, or say which are "
        "what by columns= (--columns time=NAME --columns input=NAME --columns x=NAME)",
    )


def _in_words(roles: Sequence[str]) -> str:
    return ", ".join(f"{role}_*" if role in SEVERAL else role for role in roles)


def _role_of(name: str) -> str:
    """Return the role that a column has by its name, "" if it is none."""
    begin, _, end = name.partition("_")
    if begin in SEVERAL or (begin == TIME and time_unit(end)):
        return begin
    return name if name in KEYS else ""


def _column(role: str, header: str, units: Units, source: str) -> Column:
    name, unit = split(header)
    given = units.get(header, units.get(name, ""))
    got = f"[{unit}] in the header of {source} and {given} in units"
    is_one = not (unit and given and unit != given)
    advice = "convert the numbers, or correct one"
    require(is_one, f"one unit of column {header}", got, advice)
    unit = unit or given or (time_unit(header) if role == TIME else "")
    factor, si = to_si(unit) or (1.0, unit)
    got, is_time = f"{unit} in column {header} of {source}", si in ("", "s")
    expected = "times in s, ms, us, ns, min or h"
    require(role != TIME or is_time, expected, got, "convert them")
    for begin in SEVERAL:
        name = name.removeprefix(f"{begin}_")
    return Column(role, header, name, si, factor)
