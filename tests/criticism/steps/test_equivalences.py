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
        plan=False,
    )


def printed(report: Report) -> set[frozenset[str]]:
    """Return the groups that the text says no permitted action separates."""
    end = ": no permitted action separates them"
    lines = [line for line in str(report).splitlines() if line.endswith(end)]
    return {frozenset(line[2 : -len(end)].split(" = ")) for line in lines}


@pytest.mark.parametrize("one_way", [True, False])
def test_world_b_tilt_hides_where_pushes_go_one_way(one_way):
    world = get_world("B", one_way=one_way)
    found = printed(report_on(world, "tilt", "camera bias", "speed offset"))
    assert found == ({frozenset({"none", "tilt"})} if one_way else set())


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
        plan=False,
    )
    assert report.tracing.equivalent == ()
    assert (frozenset(NEAR) in report.tracing.aliases) is is_near
