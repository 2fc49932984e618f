"""Effects that no permitted action separates, printed as such on the worlds."""

import pytest

from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.worlds import get_world
from sbi_active.criticism import Report, close_loop


def report_on(world, *names: str, number: int = 0, kind="clean") -> Report:
    problem = draw_case(world, kind, number, num_trials=6, num_held_out=0).problem
    return close_loop(
        problem.model,
        problem.prior,
        problem.trials,
        effects=[e for e in problem.effects if e.name in names],
        actions=problem.actions,
        evaluate=False,
    )


def printed(report: Report) -> set[frozenset[str]]:
    """Return the groups that the text says no permitted action separates."""
    end = ": no permitted action separates them"
    lines = [line for line in str(report).splitlines() if line.endswith(end)]
    return {frozenset(line[2 : -len(end)].split(" = ")) for line in lines}


def test_world_a():
    names = ("bias", "gain", "action offset", "quadratic", "drift")
    found = printed(report_on(get_world("A"), *names))
    assert found == {
        frozenset({"gain", "none"}),
        frozenset({"bias", "action offset"}),
    }


@pytest.mark.parametrize("one_way", [True, False])
def test_world_b_tilt_hides_where_pushes_go_one_way(one_way):
    world = get_world("B", one_way=one_way)
    found = printed(report_on(world, "tilt", "camera bias", "speed offset"))
    assert found == ({frozenset({"none", "tilt"})} if one_way else set())


def test_the_verdict_line_names_the_equivalent():
    world, names = get_world("A"), ("bias", "action offset")
    cases = (draw_case(world, "library", n, num_trials=6).truth for n in range(100))
    number = next(
        n
        for n, truth in enumerate(cases)
        if truth.names == ("bias",) and truth.non_centrality > 50
    )
    first = str(report_on(world, *names, number=number, kind="library")).splitlines()[0]
    other = {"bias": "action offset", "action offset": "bias"}
    verdict = first.removeprefix("Verdict: ").split(" (P")[0]
    assert first.endswith(f"; no permitted action tells it from {other[verdict]}")


NEAR = "speed gain", "camera scale"


@pytest.mark.parametrize(("number", "is_near"), [(51, True), (23, False)])
def test_world_b_speed_gain_is_nearly_camera_scale_where_data_are_weak(number, is_near):
    """Case 23 is a scale of the camera that the trials tell from a gain of speed."""
    case = draw_case(get_world("B"), "library", number, num_held_out=0)
    assert case.truth.names[0] in NEAR
    problem = case.problem
    report = close_loop(
        problem.model,
        problem.prior,
        problem.trials,
        effects=[e for e in problem.effects if e.name in NEAR],
        actions=problem.actions,
        evaluate=False,
    )
    assert report.tracing.equivalent == ()
    assert (frozenset(NEAR) in report.tracing.aliases) is is_near
