"""The benchmark's tables in small: no count is one that its bar makes improbable.

A bar is a probability. A count is compared with the binomial distribution at the bar:
a test fails where so bad a count or a worse one has a probability below .025, the
outside of a one-sided 97.5 % interval. A median is a bar of one half.
"""

import json
from collections.abc import Callable, Sequence

import pytest
from scipy.stats import binom

from benchmarks.criticism.active import score_active
from benchmarks.criticism.cases import Kind, draw_case
from benchmarks.criticism.equivalence import merged, true_name
from benchmarks.criticism.scores import score_case
from benchmarks.criticism.worlds import get_world

LEVEL = 0.025
STRONG = 25.0  # lambda, from which an effect must be seen

Row = dict[str, object]
slow = pytest.mark.slow


def at_least(bar: float, hits: Sequence[bool]) -> bool:
    """Return whether the hits are not too few for a share of at least the bar."""
    assert len(hits) > 0
    return bool(binom.cdf(sum(hits), len(hits), bar) >= LEVEL)


def at_most(bar: float, hits: Sequence[bool]) -> bool:
    """Return whether the hits are not too many for a share of at most the bar."""
    return at_least(1 - bar, [not hit for hit in hits])


def scored(
    name: str,
    kind: Kind,
    num: int,
    *,
    num_trials: int = 8,
    scale: float = 1.0,
    wanted: Callable[[Row], bool] = lambda row: True,
    **options: bool,
) -> list[Row]:
    """Return rows of the first cases whose truth is wanted."""
    world, rows, number = get_world(name, **options), [], 0
    while len(rows) < num:
        case = draw_case(world, kind, number, num_trials=num_trials, prior_scale=scale)
        truth = case.truth
        known: Row = {
            "effects": " + ".join(truth.names),
            "lambda": truth.non_centrality,
            "support": truth.support if len(truth.effects) > 1 else 0.0,
            "correlation": truth.correlation,
        }
        if wanted(known):
            row = score_case(case, number)
            assert "failure" not in row, row["failure"]
            rows.append(row)
        number += 1
    return rows


def is_strong(row: Row) -> bool:
    return float(str(row["lambda"])) > STRONG


def detected(row: Row) -> bool:
    return row["verdict"] != "none"


def says_so(row: Row) -> bool:
    return row["verdict"] == "unexplained"


def key(name: str, effects: object) -> str:
    """Return the name under which equivalent effects are counted as one."""
    world = get_world(name)
    return next(iter(merged(world, {true_name(world, str(effects)): 1.0})))


def keys(name: str, effects: object) -> set[str]:
    return {key(name, part) for part in str(effects).split(" + ")}


def is_named(name: str, row: Row) -> bool:
    return keys(name, row["verdict"]) == keys(name, row["effects"])


def ratio(row: Row) -> float:
    return float(str(row["rmse_after"])) / float(str(row["rmse_before"]))


def loaded(row: Row, column: str):
    return json.loads(str(row[column]))


def test_a_count_that_its_bar_makes_improbable_fails():
    assert at_least(0.95, [True] * 19 + [False])
    assert not at_least(0.95, [True] * 16 + [False] * 4)
    assert at_most(0.05, [True] + [False] * 11)
    assert not at_most(0.05, [True] * 3 + [False] * 9)
    assert not at_most(0.05, [True] * 2)


# loop


@pytest.mark.parametrize(
    ("name", "num"),
    [("A", 2), *(pytest.param(name, 12, marks=slow) for name in "ABC")],
)
def test_loop_clean_sets_raise_no_more_alarms_than_allowed(name, num):
    rows = scored(name, "clean", num)
    assert at_most(0.05, [*map(detected, rows)])
    quiet = [row for row in rows if not detected(row)]
    assert all(ratio(row) == pytest.approx(1.0, abs=0.02) for row in quiet)


@pytest.mark.parametrize(
    ("name", "num"),
    [("A", 2), *(pytest.param(name, 12, marks=slow) for name in "ABC")],
)
def test_loop_strong_effects_are_found_and_named_and_lower_the_error(name, num):
    rows = scored(name, "library", num, wanted=is_strong)
    assert at_least(0.95, [*map(detected, rows)])
    found = [row for row in rows if detected(row)]
    assert at_least(0.90, [is_named(name, row) for row in found])
    assert at_least(0.50, [ratio(row) <= 0.35 for row in found])


@slow
@pytest.mark.parametrize("name", ["A", "B"])
def test_loop_credible_sets_cover_as_often_as_they_say(name):
    world = get_world(name)
    covers, mass = [], []
    for row in [*scored(name, "clean", 10), *scored(name, "library", 20)]:
        inside = {key(name, n) for n in loaded(row, "credible_set")}
        stated = merged(world, loaded(row, "probabilities"))
        covers.append(key(name, row["effects"]) in inside)
        mass.append(sum(p for n, p in stated.items() if n in inside))
    assert at_least(min(sum(mass) / len(mass), 0.999), covers)


# open


@slow
def test_open_a_removed_effect_is_said_to_be_missing_and_its_formula_named():
    rows = scored("A", "removed", 12, num_trials=12, wanted=is_strong)
    found = [row for row in rows if detected(row)]
    assert at_least(0.85, [*map(says_so, found)])
    formulas = get_world("A").formulas
    one_term = [row for row in found if row["effects"] in formulas]
    named = [row["formula"] in formulas[str(row["effects"])] for row in one_term]
    assert at_least(0.80, named)


@slow
def test_open_an_outsider_is_said_to_be_missing():
    aliases = get_world("A").aliases
    rows = scored("A", "outside", 12, num_trials=12, wanted=is_strong)
    found = [row for row in rows if detected(row)]
    far = [row for row in found if row["effects"] not in aliases]
    assert at_least(0.70, [*map(says_so, far)])


# pairs


@slow
def test_pairs_that_the_data_support_are_found_and_no_others():
    def supported(row: Row) -> bool:
        return float(str(row["support"])) > STRONG

    rows = scored("A", "pair", 10, num_trials=12, wanted=supported)
    assert at_least(0.80, [is_named("A", row) for row in rows])
    extra = [bool(keys("A", r["verdict"]) - keys("A", r["effects"])) for r in rows]
    assert at_most(0.05, extra)


# active


@slow
def test_active_choice_needs_no_more_than_seven_trials_where_random_needs_ten():
    world, better, worse, number = get_world("A"), 0, 0, 0
    for _ in range(6):
        while not is_strong({"lambda": _non_centrality(world, number)}):
            number += 1
        rows = score_active(draw_case(world, "library", number, num_trials=10), number)
        assert not any("failure" in row for row in rows)
        top = {(row["policy"], row["trials"]): bool(row["top"]) for row in rows}
        better += top["chosen", 7] and not top["random", 10]
        worse += top["random", 10] and not top["chosen", 7]
        number += 1
    # Of the cases that differ, half go either way where the two are as good.
    differ = [True] * worse + [False] * better
    assert not differ or at_most(0.5, differ)


def _non_centrality(world, number: int) -> float:
    return draw_case(world, "library", number, num_trials=10).truth.non_centrality


# priors


@slow
@pytest.mark.parametrize("scale", [1 / 3, 3.0])
def test_priors_that_are_misstated_raise_no_alarms_and_name_most(scale):
    clean = scored("A", "clean", 10, scale=scale)
    assert at_most(0.05, [*map(detected, clean)])
    rows = scored("A", "library", 10, scale=scale, wanted=is_strong)
    found = [row for row in rows if detected(row)]
    assert at_least(0.80, [is_named("A", row) for row in found])


# correlation


@slow
def test_correlated_errors_raise_no_alarms_unless_taken_as_independent():
    def correlated(row: Row) -> bool:
        return float(str(row["correlation"])) >= 0.9

    as_usual = scored("C", "clean", 8, wanted=correlated)
    assert at_most(0.05, [*map(detected, as_usual)])
    independent = scored("C", "clean", 8, wanted=correlated, assume_independent=True)
    assert not at_most(0.05, [*map(detected, independent)])
