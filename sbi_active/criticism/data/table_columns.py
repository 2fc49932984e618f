"""Roles and units of the columns of a table of trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sbi_active.criticism.data.units import TIME, split, time_unit, to_si
from sbi_active.expected import did_you_mean

TRIAL = "trial"
#: Beginnings of the names of columns that there may be several of.
PREFIXES = {"action": "action_", "x": "x_", "input": "input_", "start": "start_"}
OPTIONAL = ("role", "index", "repeat_of")
KEYS = (TRIAL, TIME, *PREFIXES, *OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Roles of the columns of a table.

    Attributes:
        action: Columns of the action.
        x: Columns of the observation.
        input: Columns of the inputs over time.
        start: Columns of the measured start state.
        trial: Columns that name the trial together, in a table with one row a sample;
            empty if a row is a trial.
        time: Column of the time stamps; None if a row is a trial.
        optional: Columns of "role", "index" and "repeat_of", where there are such.
        units: Units by column, in SI where that is known; "" if none was said.
        factors: Factors by column from the table's numbers to that unit.
    """

    action: tuple[str, ...]
    x: tuple[str, ...]
    input: tuple[str, ...]
    start: tuple[str, ...]
    trial: tuple[str, ...]
    time: str | None
    optional: dict[str, str]
    units: dict[str, str]
    factors: dict[str, float]

    def label(self, column: str) -> str:
        """Return the label of a column, with its unit, as in "speed [m/s]"."""
        unit = self.units.get(column, "")
        name = self.short(column)
        return f"{name} [{unit}]" if unit else name

    def short(self, column: str) -> str:
        """Return a column's name without its beginning and unit."""
        name = bare(column)
        for beginning in PREFIXES.values():
            name = name.removeprefix(beginning)
        return name


def find_columns(
    names: Sequence[str],
    *,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    source: str = "the table",
    of_inputs: bool = False,
    has_inputs: bool = False,
) -> Columns:
    """Return the roles of the columns, by their names or as the user says.

    Args:
        names: Names of all columns.
        columns: Names of those that are "trial", "time", "action", "x", "input",
            "start", "role", "index" or "repeat_of"; others are then ignored. None goes
            by the names.
        units: Units by column, with or without what stands in its brackets.
        source: Name of the table in messages.
        of_inputs: The table holds times and inputs alone, and those of all trials
            where no column names the trial.
        has_inputs: Inputs stand in another table, so that no action is needed.

    Raises:
        ValueError: If a column is missing, unknown or there twice, or has two units.
    """
    twice = sorted({name for name in names if [*names].count(name) > 1})
    if twice:
        raise ValueError(
            f"expected each column once; got {', '.join(twice)} more than once in "
            f"{source}; remove or rename one"
        )
    if columns is None:
        found, one = _by_name(names, source), "one column"
    else:
        found, one = _as_told(names, columns, source), "one column for"
    for key in (TIME, *OPTIONAL, *[TRIAL] * (columns is None)):
        if len(found[key]) > 1:
            raise ValueError(
                f"expected {one} {key}; got {', '.join(found[key])} in "
                f"{source}; keep one"
            )
    if of_inputs:
        _require_inputs(found, names, source)
    elif bool(found[TRIAL]) != bool(found[TIME]):
        there, missing = (TRIAL, TIME) if found[TRIAL] else (TIME, TRIAL)
        raise ValueError(
            f"expected columns {TRIAL} and {TIME} in a table with one row a sample; "
            f"got {there} without {missing} in {source}; add a column {missing}, or "
            f"remove {there} where a row is a trial"
        )
    if found["input"] and not found[TIME]:
        raise ValueError(
            f"expected columns {TRIAL} and {TIME} with inputs over time; got "
            f"{', '.join(found['input'])} without in {source}; write one row a sample, "
            "or call what does not vary in time action_*"
        )
    needed = [] if of_inputs else ["x"]
    if not (of_inputs or has_inputs or found["input"]):
        needed = ["action", "x"]
    missing = [key for key in needed if not found[key]]
    if missing:
        nothing = "; where nothing was set, add a column action_none of ones"
        raise ValueError(
            f"expected columns {' and '.join(f'{PREFIXES[k]}*' for k in missing)}; got "
            f"{', '.join(names)} in {source}; name them, as in action_speed, "
            "x_distance[m], or say which columns are what"
            f"{nothing if 'action' in missing else ''}"
        )
    used = [name for group in found.values() for name in group]
    stated = _units(used, names, units or {}, source)
    time = found[TIME][0] if found[TIME] else None
    if time is not None:
        stated[time] = stated[time] or time_unit(time)
    converted = {c: to_si(unit) or (1.0, unit) for c, unit in stated.items()}
    if time is not None and converted[time][1] not in ("", "s"):
        raise ValueError(
            f"expected times in s, ms, us, ns, min or h; got {stated[time]} in column "
            f"{time} of {source}; convert them"
        )
    return Columns(
        **{key: found[key] for key in (*PREFIXES, TRIAL)},
        time=time,
        optional={key: found[key][0] for key in OPTIONAL if found[key]},
        units={column: unit for column, (_, unit) in converted.items()},
        factors={column: factor for column, (factor, _) in converted.items()},
    )


def _require_inputs(
    found: Mapping[str, tuple[str, ...]], names: Sequence[str], source: str
) -> None:
    """Raise if a table of inputs lacks them or their times, or holds more."""
    needed = {TIME: TIME, "input": "input_*"}
    absent = [column for key, column in needed.items() if not found[key]]
    others = [n for key in ("action", "x", "start", *OPTIONAL) for n in found[key]]
    if absent or others:
        remedy = f"add {absent[0]}" if absent else "move them to the table of trials"
        raise ValueError(
            f"expected columns {TRIAL}, {TIME}, input_* in a table of inputs; got "
            f"{', '.join(names if absent else others)} in {source}; {remedy}"
        )


def _by_name(names: Sequence[str], source: str) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {key: [] for key in (*KEYS, "")}
    for name in names:
        word = bare(name)
        key = word if word in (TRIAL, TIME, *OPTIONAL) else ""
        for kind, prefix in PREFIXES.items():
            key = kind if word.startswith(prefix) else key
        found[key].append(name)
    unknown = found.pop("")
    if unknown and (found["input"] or (found["action"] and found["x"])):
        every = ", ".join(f"{prefix}*" for prefix in PREFIXES.values())
        raise ValueError(
            f"expected columns {every}, {TRIAL}, {TIME}, "
            f"{', '.join(OPTIONAL)}; got {', '.join(unknown)} in {source}; rename "
            "or remove what is none of these, or say which columns are what"
        )
    return {key: (*group,) for key, group in found.items()}


def _as_told(
    names: Sequence[str], columns: Mapping[str, str | Sequence[str]], source: str
) -> dict[str, tuple[str, ...]]:
    wrong = [key for key in columns if key not in KEYS]
    if wrong:
        raise ValueError(
            f"expected columns of {', '.join(KEYS)}; got {', '.join(wrong)}; say "
            "which columns are these"
        )
    of = {bare(name): name for name in names} | {name: name for name in names}
    found: dict[str, tuple[str, ...]] = dict.fromkeys(KEYS, ())
    for key, value in columns.items():
        told = as_list(value)
        for name in [name for name in told if name not in of]:
            raise ValueError(
                f"expected a column {name} for {key}; got {', '.join(names)} in "
                f"{source}; {did_you_mean(name, names, 'correct the name')}"
            )
        found[key] = tuple(of[name] for name in told)
    return found


def _units(
    used: Sequence[str], names: Sequence[str], units: Mapping[str, str], source: str
) -> dict[str, str]:
    unknown = {*units} - {*names, *map(bare, names)}
    if unknown:
        raise ValueError(
            f"expected units of columns {', '.join(names)}; got one of "
            f"{', '.join(sorted(unknown))}; correct the name"
        )
    found: dict[str, str] = {}
    seen: dict[str, str] = {}
    for name in used:
        header = split(name)[1]
        given = units.get(name, units.get(bare(name), ""))
        if header and given and header != given:
            raise ValueError(
                f"expected one unit of column {name}; got [{header}] in the header of "
                f"{source} and {given} in units; convert the numbers, or correct one"
            )
        found[name] = header or given
        other = seen.setdefault(bare(name), name)
        if other != name:
            raise ValueError(
                f"expected each quantity in one unit; got {other} and {name} in "
                f"{source}; convert one and merge them"
            )
    return found


def as_list(value: str | Sequence[str]) -> list[str]:
    """Return a name, or several, as a list."""
    return [value] if isinstance(value, str) else [*value]


def bare(name: str) -> str:
    """Return a column's name without its unit."""
    return split(name)[0]
