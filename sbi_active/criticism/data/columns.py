"""Roles of the columns of a table, and their units, which are converted to SI.

A unit stands in brackets, as in "height [mm]", that of the time also at the end of its
name, as in "time_ms". What is no scale of an SI unit, such as "px", has no factor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
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
    factor, sign, text, at = 1.0, 1, "", 0
    while at < len(unit):
        token = _TOKEN.match(unit, at)
        if token is None:
            return None
        at, said = token.end(), token.group()
        if token["word"] is None:
            sign = -1 if said == "/" else sign
            text += said
            continue
        if token["word"] not in WORDS:
            return None
        scale, si = WORDS[token["word"]]
        power = token["power"].replace("²", "2").replace("³", "3").lstrip("^*") or "1"
        factor *= scale ** (sign * int(power))
        text += si + token["power"]
    return factor, text


def split(column: str) -> tuple[str, str]:
    """Return the name in a column or a label, and the unit; "" if there is none.

    Example:
        >>> split("angle [deg]"), split("time_ms"), split("x_height")
        (('angle', 'deg'), ('time', 'ms'), ('x_height', ''))
    """
    match = re.fullmatch(r"(.*?)\s*\[(.*)\]\s*", column)
    if match is not None:
        return match[1], match[2].strip()
    end = time_unit(column)
    is_time = end and column == f"{TIME}_{end}"
    return (TIME, end) if is_time else (column, "")


def time_unit(column: str) -> str:
    """Return the unit of time at the end of a column's name, "" if there is none."""
    end = column.rpartition("_")[2]
    return end if end and (to_si(end) or ("", ""))[1] == "s" else ""


TRIAL = "trial"
#: Beginnings of the names of columns that there may be several of.
PREFIXES = {"action": "action_", "x": "x_", "input": "input_", "start": "start_"}
OPTIONAL = ("role", "index", "repeat_of")
KEYS = (TRIAL, TIME, *PREFIXES, *OPTIONAL)

#: Names of columns by what they are, where they have names of their own.
Told = Mapping[str, str | Sequence[str]]


@dataclass(frozen=True)
class Column:
    """A column of numbers, in SI where its unit is known.

    Attributes:
        header: Name of the column in the table.
        name: Name without the beginning and the unit.
        unit: Unit of its numbers here; "" if none was said.
        factor: Factor from the table's numbers to that unit.
    """

    header: str
    name: str
    unit: str = ""
    factor: float = 1.0

    @property
    def label(self) -> str:
        """Name and unit, as in "speed [m/s]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def find_columns(
    headers: Sequence[str],
    *,
    columns: Told | None = None,
    units: Mapping[str, str] | None = None,
    source: str = "the table",
) -> dict[str, list[Column]]:
    """Return the columns by what they are, by their names or as the user says.

    Args:
        headers: Names of all columns.
        columns: Names of those that are "trial", "time", "action", "x", "input",
            "start", "role", "index" or "repeat_of"; others are then ignored. None goes
            by the names.
        units: Units by column, with or without what stands in its brackets.
        source: Name of the table in messages.

    Raises:
        ValueError: If a column is missing, unknown or there twice, or has two units.
    """
    if columns is None:
        roles, single = _by_name(headers, source), (TRIAL, TIME, *OPTIONAL)
    else:
        roles, single = _as_told(headers, columns, source), (TIME, *OPTIONAL)
    for role in single:
        got = f"{', '.join(roles[role])} in {source}"
        require(len(roles[role]) <= 1, f"one column for {role}", got, "keep one")
    used = [header for group in roles.values() for header in group]
    names = [split(header)[0] for header in headers]
    for header in used:
        same = [h for h, n in zip(headers, names, strict=True) if n == split(header)[0]]
        got = f"{' and '.join(same)} in {source}"
        require(len(same) == 1, "each quantity once", got, "remove or rename one")
    return {
        role: [_column(role, header, units or {}, source) for header in group]
        for role, group in roles.items()
    }


def require_columns(
    found: Mapping[str, Sequence[Column]], needed: Sequence[str], source: str
) -> None:
    """Raise if a table lacks columns.

    Args:
        found: Columns by what they are.
        needed: Kinds of columns that it needs.
        source: Name of the table in messages.
    """
    there = [column.header for group in found.values() for column in group]
    names = [f"{PREFIXES[role]}*" if role in PREFIXES else role for role in needed]
    require(
        all(found[role] for role in needed),
        f"columns {', '.join(names)}",
        f"{', '.join(there) or 'none of these'} in {source}",
        "name them, as in action_speed, x_distance[m] (action_none, of ones, where "
        "nothing was set), input_voltage[V] where it varies in time, or say which are "
        "what by columns= (--columns time=NAME --columns input=NAME --columns x=NAME)",
    )


def _by_name(headers: Sequence[str], source: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {key: [] for key in KEYS}
    unknown = []
    for header in headers:
        name = split(header)[0]
        of_prefix = (role for role, start in PREFIXES.items() if name.startswith(start))
        found.get(next(of_prefix, name), unknown).append(header)
    # A table in which nothing has such a name is said to lack those.
    is_understood = found["input"] or (found["action"] and found["x"])
    require(
        not (unknown and is_understood),
        f"columns {', '.join(f'{prefix}*' for prefix in PREFIXES.values())}, {TRIAL}, "
        f"{TIME}, {', '.join(OPTIONAL)}",
        f"{', '.join(unknown)} in {source}",
        "rename or remove what is none of these, or say which are what by columns= "
        "(--columns x=NAME)",
    )
    return found


def _as_told(
    headers: Sequence[str], columns: Told, source: str
) -> dict[str, list[str]]:
    for key in columns:
        known = f"columns of {', '.join(KEYS)}"
        require(key in KEYS, known, key, "say which columns are these")
    of = {split(name)[0]: name for name in headers} | {name: name for name in headers}
    found: dict[str, list[str]] = {key: [] for key in KEYS}
    for role, value in columns.items():
        for name in as_list(value):
            require(
                name in of,
                f"a column {name} for {role}",
                f"{', '.join(headers)} in {source}",
                did_you_mean(name, headers, "correct the name"),
            )
            found[role].append(of[name])
    return found


def _column(role: str, header: str, units: Mapping[str, str], source: str) -> Column:
    name, unit = split(header)
    given = units.get(header, units.get(name, ""))
    require(
        not (unit and given and unit != given),
        f"one unit of column {header}",
        f"[{unit}] in the header of {source} and {given} in units",
        "convert the numbers, or correct one",
    )
    unit = unit or given or (time_unit(header) if role == TIME else "")
    factor, si = to_si(unit) or (1.0, unit)
    require(
        role != TIME or si in ("", "s"),
        "times in s, ms, us, ns, min or h",
        f"{unit} in column {header} of {source}",
        "convert them",
    )
    for prefix in PREFIXES.values():
        name = name.removeprefix(prefix)
    return Column(header, name, si, factor)


def as_list(value: str | Sequence[str]) -> list[str]:
    """Return a name, or several, as a list."""
    return [value] if isinstance(value, str) else [*value]
