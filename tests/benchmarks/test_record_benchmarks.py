"""Records of real machines: plain least squares finds what others found.

Figures of other studies of the same records, with SciPy and other integrators, are
compared within some per cent.
"""

import pytest
import torch

from benchmarks.measured.ball_and_hoop import fit_hoop, free_run
from benchmarks.measured.cascaded_tanks import fit_tanks, score
from sbi_active.tasks import ball_and_hoop, cascaded_tanks  # pyright: ignore

HOOP, TANKS = (m.DATA.resolve() for m in (ball_and_hoop, cascaded_tanks))
slow = pytest.mark.slow
needs_hoop = pytest.mark.skipif(
    not HOOP.is_dir(), reason=f"needs the records of the hoop in {HOOP}"
)
needs_tanks = pytest.mark.skipif(
    not TANKS.is_dir(), reason=f"needs the records of the tanks in {TANKS}"
)


def hoop_errors(names):
    records = ball_and_hoop.read_recordings(HOOP)
    _, held = ball_and_hoop.split(records)
    fit, effects = fit_hoop(records["random_steps"], names, starts=2)
    own = torch.from_numpy(fit.parameters)[None]
    return fit, [*free_run(own, held, effects).values()]


@needs_hoop
def test_a_linear_hoop_errs_as_others_found():
    _, errors = hoop_errors(())
    assert errors == pytest.approx([2.51, 2.03, 1.96], rel=0.01)


@needs_hoop
def test_quadratic_drag_explains_most_of_the_hoop():
    _, errors = hoop_errors(("quadratic drag",))
    assert errors == pytest.approx([0.70, 0.41, 0.47], rel=0.06)


def tank_error(names):
    records = cascaded_tanks.read_recordings(TANKS)
    _, scored = cascaded_tanks.split(records)
    fit, effects = fit_tanks(records["estimation"], names, starts=2)
    own = torch.from_numpy(fit.parameters[:-2])[None]
    return score(own, scored, effects)["validation"]


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ((), 0.686),
        pytest.param(("linear outflow",), 0.656, marks=slow),
        pytest.param(("overflow",), 0.557, marks=slow),
        pytest.param(("overflow", "linear outflow"), 0.290, marks=slow),
    ],
)
@needs_tanks
def test_tanks_err_as_others_found(names, found):
    assert tank_error(names) == pytest.approx(found, rel=0.1)
