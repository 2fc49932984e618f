"""Units in the headers of tables and logs, which are converted to SI.

A unit stands in brackets, as in "height [mm]", that of the time also at the end of its
name, as in "time_ms". What is no scale of an SI unit, such as "px", has no factor.
"""

from __future__ import annotations

import math
import re

TIME = "time"
PREFIXES = {"": 1.0, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9}
BASES = {b: b for b in ("m", "s", "N", "V", "A", "W", "J", "Hz", "Pa", "rad")}
#: Factor and SI unit of each word; "g" and "mg" are masses or accelerations, and not
#: among them.
WORDS = {p + b: (f, s) for p, f in PREFIXES.items() for b, s in BASES.items()} | {
    **{f"{p}Nm": (f, "N m") for p, f in PREFIXES.items()},
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
