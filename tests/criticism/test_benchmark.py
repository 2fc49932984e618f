"""The benchmark's tables in small: the bars lie within the binomial intervals."""

import pytest

from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.equivalence import true_name
from benchmarks.criticism.intervals import wilson
from benchmarks.criticism.scores import score_case
from benchmarks.criticism.worlds import get_world

NUM_CASES = 12


@pytest.mark.slow
@pytest.mark.parametrize("name", ["A", "B"])
def test_clean_sets_raise_no_more_alarms_than_allowed(name):
    world = get_world(name)
    rows = [score_case(draw_case(world, "clean", i), i) for i in range(NUM_CASES)]
    assert not any("failure" in row for row in rows)
    alarms = [row for row in rows if row["verdict"] != "none"]
    assert wilson(len(alarms), NUM_CASES)[0] <= 0.05
    ratios = [float(str(r["rmse_after"])) / float(str(r["rmse_before"])) for r in rows]
    assert sum(ratios) / NUM_CASES == pytest.approx(1.0, abs=0.02) or alarms


@pytest.mark.slow
@pytest.mark.parametrize("name", ["A", "B"])
def test_strong_effects_are_found_and_named(name):
    world = get_world(name)
    cases = [draw_case(world, "library", i) for i in range(NUM_CASES)]
    strong = [(i, c) for i, c in enumerate(cases) if c.truth.non_centrality > 30]
    assert len(strong) >= 4
    rows = [score_case(case, i) for i, case in strong]
    assert not any("failure" in row for row in rows)
    found = [row["verdict"] != "none" for row in rows]
    assert wilson(sum(found), len(found))[1] >= 0.95
    named = [
        str(row["verdict"]) in world.equivalent(true_name(world, str(row["effects"])))
        for row in rows
    ]
    assert wilson(sum(named), len(named))[1] >= 0.90
