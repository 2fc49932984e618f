"""The tables of the results, with binomial intervals."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.criticism.active import DETECTABLE, SCORES, Curves, merged, true_name
from benchmarks.criticism.cases import SUPPORTED
from benchmarks.criticism.intervals import brier_score, rate, reliability
from benchmarks.criticism.worlds import World, get_world
from benchmarks.rows import column, grouped
from sbi_active.criticism.contradictions import UNDECLARED

Row = Mapping[str, str]
#: Of lambda, residual sum of squares in units of the noise.
BINS = ((0.0, 10.0), (10.0, 25.0), (25.0, np.inf))


def summary(rows: Sequence[Row]) -> str:
    """Return the lines of each world and kind, and what both sets of a world tell."""
    lines: list[str] = []
    for (name,), every in grouped(rows, "world").items():
        world = get_world(name)
        found = {kind: own for (kind,), own in grouped(every, "kind").items()}
        for kind, own in found.items():
            drawn = "library" if kind == "active" else kind
            lines += ["", f"## world {name}, {drawn}: {len(own)} cases"]
            failed = [r for r in own if r.get("failure")]
            lines += [f"failed {r['case']}: {r['failure']}" for r in failed]
            ended = [r for r in own if not r.get("failure")]
            if ended:
                lines += [*SUMMARIES[kind](world, ended), *_cost(ended)]
        if {"clean", "library"} <= {*found}:
            # As many of each, as the prior has it: "none" is right in half of the sets.
            both = found["clean"], found["library"]
            num = min(map(len, both))
            first = [sorted(own, key=lambda r: int(r["case"]))[:num] for own in both]
            ended = [r for own in first for r in own if not r.get("failure")]
            lines += ["", f"## calibration, {num} clean and {num} library sets"]
            lines += _calibration(world, ended) if ended else []
    return "\n".join(lines)


def _clean(world: World, rows: Sequence[Row]) -> list[str]:
    ratio = _ratio(rows, "rmse_after", "rmse_before")
    unexplained = [r["verdict"] == "unexplained" for r in rows]
    return [
        f"false alarms {rate([*map(_detected, rows)])}",
        f'false "unexplained" {rate(unexplained)}',
        f"RMSE after/before: mean {ratio.mean():.3f}, range {_range(ratio)}",
    ]


def _library(world: World, rows: Sequence[Row]) -> list[str]:
    scattered = [r for r in rows if r["effects"] == world.scatter.name]
    named = [r for r in rows if r["effects"] != world.scatter.name]
    lines = _power(named)
    seen = [r for r in strong(world, rows) if _detected(r)]
    places = ranks(world, seen)
    lines += [
        f"top-1 {rate([k == 1 for k in places])}",
        f"top-2 {rate([k <= 2 for k in places])}",
        f"mean of the largest stated probability {_mean_largest(world, seen):.3f}",
        f"verdict right {rate([_right(world, r) for r in seen])}",
        "of noise inflation, called scatter "
        + rate([r["verdict"] == "scatter" for r in scattered if _detected(r)])
        + f", detected {sum(map(_detected, scattered))}/{len(scattered)}",
    ]
    if said := [r["undeclared"] == "1" for r in named if r["undeclared"]]:
        lines.append(f'false "{UNDECLARED}" {rate(said)}')
    for name in world.hidden:
        lines += _of_effect(name, [r for r in named if r["effects"] == name])
    lines += _separated(rows)
    return [*lines, *_errors([r for r in named if _detected(r)])]


def strong(world: World, rows: Sequence[Row]) -> list[Row]:
    """Return the rows of effects that matter, noise inflation apart."""
    named = [r for r in rows if r["effects"] != world.scatter.name]
    return [r for r in named if float(r["lambda"]) > BINS[-1][0]]


def ranks(world: World, rows: Sequence[Row]) -> list[int]:
    """Return the true effect's place among the effects, in the rows with an alarm."""
    return [_rank(world, r) for r in rows if _detected(r)]


def _of_effect(name: str, rows: Sequence[Row]) -> list[str]:
    strong = [_detected(r) for r in rows if float(r["lambda"]) > BINS[-1][0]]
    verdicts = Counter(r["verdict"] for r in rows if _detected(r))
    called = ", ".join(f"{v} {n}" for v, n in verdicts.most_common())
    return [
        f"{name}: detected {sum(map(_detected, rows))} of {len(rows)}, lambda > 25 "
        f"{sum(strong)} of {len(strong)}; called {called or '-'}"
    ]


def _separated(rows: Sequence[Row]) -> list[str]:
    """Return which effects reports say that no permitted action separates."""
    groups = Counter(
        " = ".join(sorted(group))
        for r in rows
        for group in json.loads(r["equivalent"] or "[]")
    )
    return [
        f"inseparable in the report: {group}, {n} of {len(rows)}"
        for group, n in groups.most_common()
    ]


def _power(rows: Sequence[Row]) -> list[str]:
    lines = []
    for low, high in BINS:
        inside = [r for r in rows if low <= float(r["lambda"]) < high]
        lines.append(
            f"detected, lambda in {low:g}-{high:g}: {rate([*map(_detected, inside)])}"
        )
    return lines


def _errors(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    ratio = _ratio(rows, "rmse_after", "rmse_before")
    lines = [
        f"RMSE after/before, detected sets: median {np.median(ratio):.2f}, "
        f"range {_range(ratio)}"
    ]
    known = [r for r in rows if r["rmse_oracle"]]
    if known:
        best = _ratio(known, "rmse_after", "rmse_oracle")
        lines.append(
            f"RMSE after/oracle: median {np.median(best):.3f}, "
            f"90th percentile {np.percentile(best, 90):.3f}"
        )
    before, after = column(rows, "coverage_before"), column(rows, "coverage_after")
    return [*lines, f"90 % coverage: {before.mean():.2f} -> {after.mean():.2f}"]


def _removed(world: World, rows: Sequence[Row]) -> list[str]:
    strong = [r for r in rows if float(r["lambda"]) > BINS[-1][0]]
    apart = [r for r in rows if float(r["support"]) > SUPPORTED]
    said = [_unexplained(r) for r in apart if _detected(r)]
    return [
        *_power(rows),
        f"says so, where one or two of those declared leave lambda > 25 {rate(said)}",
        *_said_so(world, "all", [r for r in rows if _detected(r)]),
        *_said_so(world, "lambda > 25", [r for r in strong if _detected(r)]),
    ]


def _said_so(world: World, title: str, rows: Sequence[Row]) -> list[str]:
    formulas = [r for r in rows if r["effects"] in world.formulas]
    hits = [r["formula"] in world.formulas[r["effects"]] for r in formulas]
    return [
        f"says so ({title}) {rate([*map(_unexplained, rows)])}",
        f'the same, or names an effect "beside {UNDECLARED}" ({title}) '
        f"{rate([_unexplained(r) or r['undeclared'] == '1' for r in rows])}",
        f"names the formula ({title}) {rate(hits)}",
    ]


def _outside(world: World, rows: Sequence[Row]) -> list[str]:
    near = [r for r in rows if r["effects"] in world.aliases]
    far = [r for r in rows if r["effects"] not in world.aliases]
    return [
        *_power(rows),
        "says so, no alias in the library "
        + rate([_unexplained(r) for r in far if _detected(r)]),
        "says so or names an alias, near-aliases "
        + rate([_aliased(world, r) for r in near if _detected(r)]),
        *_said_so(world, "all", [r for r in rows if _detected(r)]),
    ]


def _pair(world: World, rows: Sequence[Row]) -> list[str]:
    supported = [r for r in rows if float(r["support"]) > SUPPORTED]
    exact = [_right(world, r) for r in supported]

    def names_more(row: Row) -> bool:
        return bool(_names(world, row["verdict"]) - _names(world, row["effects"]))

    return [
        f"exact, both supported (lambda without either > 25) {rate(exact)}",
        f"false inclusion, both supported {rate([*map(names_more, supported)])}",
        f"false inclusion, all {rate([*map(names_more, rows)])}",
    ]


def _active(world: World, rows: Sequence[Row]) -> list[str]:
    curves = Curves.of(rows)
    lines = [
        f"detectable (lambda > {DETECTABLE:g} with all random trials): "
        f"{curves.num_cases} of {len({r['case'] for r in rows})} cases"
    ]
    if not curves.num_cases:
        return lines
    for score in SCORES:
        lines += [f"{score}", "trials  random  chosen  matched by chosen trials"]
        for num in curves.trials:
            random, chosen = (curves.mean(score, p)[num] for p in ("random", "chosen"))
            matched = curves.matched(score, num)
            ratio = f"{matched:.1f} ({matched / num:.2f})"
            cell = ratio if np.isfinite(matched) else "not reached"
            lines.append(f"{num:6d}  {random:6.3f}  {chosen:6.3f}  {cell}")
        low, high = curves.interval(score)
        lines.append(f"ratio at the last, 90 % bootstrap over cases: {low}-{high}")
    return lines


def _calibration(world: World, rows: Sequence[Row]) -> list[str]:
    stated = [merged(world, json.loads(r["probabilities"])) for r in rows]
    truth = [_key(world, r["effects"]) for r in rows]
    sets = [{_key(world, n) for n in json.loads(r["credible_set"])} for r in rows]
    covered = [t in names for t, names in zip(truth, sets, strict=True)]
    mass = [
        sum(p for k, p in row.items() if k in names)
        for row, names in zip(stated, sets, strict=True)
    ]
    lines = [
        f"credible set: covers {rate(covered)}, mean stated mass {np.mean(mass):.3f}",
        f"Brier score {brier_score(stated, truth):.3f}",
        "stated probability, share true, count",
    ]
    return lines + [
        f"  {p:.3f}  {hit:.3f}  {n}" for p, hit, n in reliability(stated, truth)
    ]


def _cost(rows: Sequence[Row]) -> list[str]:
    rows = [r for r in rows if r.get("cpu_seconds")]  # others were left out
    if not rows:
        return []
    seconds, sims = column(rows, "cpu_seconds"), column(rows, "trial_simulations")
    return [
        f"CPU s: median {np.median(seconds):.1f}, 95th percentile "
        f"{np.percentile(seconds, 95):.1f}; trial simulations: median "
        f"{np.median(sims):.0f}, max {sims.max():.0f}"
    ]


def _detected(row: Row) -> bool:
    return row["verdict"] != "none"


def _unexplained(row: Row) -> bool:
    return row["verdict"] == "unexplained" or bool(row["formula"])


def _aliased(world: World, row: Row) -> bool:
    return _unexplained(row) or row["verdict"] in world.aliases[row["effects"]]


def _names(world: World, text: str) -> set[str]:
    return {_key(world, name) for name in text.split(" + ")}


def _mean_largest(world: World, rows: Sequence[Row]) -> float:
    """Return what top-1 would be on average if the stated probabilities are right."""
    if not rows:
        return float("nan")
    stated = [merged(world, json.loads(r["probabilities"])) for r in rows]
    return float(np.mean([max(row.values()) for row in stated]))


def _right(world: World, row: Row) -> bool:
    return _names(world, row["verdict"]) == _names(world, row["effects"])


def _rank(world: World, row: Row) -> int:
    """Return the true effect's place among the effects, 1 for the most likely."""
    stated = merged(world, json.loads(row["probabilities"]))
    order = [name for name in stated if name != "none"]
    key = _key(world, row["effects"])
    return order.index(key) + 1 if key in order else len(order) + 1


def _key(world: World, effects: str) -> str:
    """Return the one name under which equivalent effects are counted."""
    return next(iter(merged(world, {true_name(world, effects): 1.0})))


def _ratio(rows: Sequence[Row], key: str, to: str) -> np.ndarray:
    return column(rows, key) / column(rows, to)


def _range(values: np.ndarray) -> str:
    return f"{values.min():.2f}-{values.max():.2f}"


SUMMARIES: dict[str, Callable[[World, Sequence[Row]], list[str]]] = {
    "clean": _clean,
    "library": _library,
    "removed": _removed,
    "inexpressible": _removed,
    "outside": _outside,
    "pair": _pair,
    "active": _active,
}
