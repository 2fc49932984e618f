"""Records of real machines: plain least squares finds what others found.

Figures of other studies of the same records, with SciPy and other integrators, are
compared within some per cent.
"""

from dataclasses import replace

import pytest
import torch

from benchmarks.measured import record_least_squares
from benchmarks.measured.hoop_least_squares import fit_hoop, free_run, run_pieces
from benchmarks.measured.tanks_least_squares import fit_pieces, fit_tanks, score
from sbi_active.tasks import ball_and_hoop, cascaded_tanks  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.recordings import FITTED  # pyright: ignore
from sbi_active.tasks.records import cut  # pyright: ignore

HOOP, TANKS = (m.DATA.resolve() for m in (ball_and_hoop, cascaded_tanks))
slow = pytest.mark.slow
needs_hoop = pytest.mark.skipif(
    not HOOP.is_dir(), reason=f"needs the records of the hoop in {HOOP}"
)
needs_tanks = pytest.mark.skipif(
    not TANKS.is_dir(), reason=f"needs the records of the tanks in {TANKS}"
)


@pytest.fixture(autouse=True)
def two_starts(monkeypatch):
    search = replace(record_least_squares.SEARCH, starts=2)
    monkeypatch.setattr(record_least_squares, "SEARCH", search)


def hoop_errors(names, **options):
    records = ball_and_hoop.read_recordings(HOOP)
    _, held = ball_and_hoop.split(records)
    fit, effects = fit_hoop(records["random_steps"], names, **options)
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


@needs_hoop
def test_drag_and_dry_friction_of_the_hoop_with_an_amplifier_that_has_no_offset():
    _, errors = hoop_errors(("Coulomb", "quadratic drag"), offset=0.0)
    assert errors == pytest.approx([0.50, 0.32, 0.30], rel=0.25)
    assert errors[0] < 0.55


@needs_hoop
def test_dry_friction_of_a_hoop_that_turns_one_way_is_an_offset_of_the_input():
    """The error found by others, 4.31, 3.48 and 3.19 V, lies on a line of best fits."""
    records = ball_and_hoop.read_recordings(HOOP)
    _, held = ball_and_hoop.split(records)
    whole = cut(records["random_steps"].part(0, FITTED + 1), FITTED)
    (coulomb,) = (e for e in ball_and_hoop.make_effects() if e.name == "Coulomb")
    drive, damping, offset = 7.3495, 0.7858, 0.14252
    friction = torch.tensor([0.0, 1.08, 2.0], dtype=torch.float64)
    z = torch.tensor([[drive, damping, offset, 0.0]], dtype=torch.float64).repeat(3, 1)
    z[:, 2] += friction / drive
    z[:, 3] = friction
    x = run_pieces(z, whole, [coulomb])[:, 0]
    fitted = (x - torch.from_numpy(whole.output[0])).square().mean(1).sqrt()
    torch.testing.assert_close(fitted, fitted[:1].expand(3), rtol=1e-3, atol=0)
    errors = [[*free_run(row[None], held, [coulomb]).values()] for row in z]
    assert errors[0] == pytest.approx([2.51, 2.03, 1.96], rel=0.01)
    assert errors[1] == pytest.approx([4.31, 3.48, 3.19], rel=0.03)
    assert errors[2][0] > errors[1][0]


def tank_error(names):
    records = cascaded_tanks.read_recordings(TANKS)
    _, scored = cascaded_tanks.split(records)
    fit, effects = fit_tanks(records["estimation"], names)
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


@needs_tanks
@pytest.mark.slow
def test_pieces_of_the_tanks_tell_as_much_as_the_whole_record():
    records = cascaded_tanks.read_recordings(TANKS)
    pieces, scored = cascaded_tanks.split(records)
    assert len(pieces) == 6
    errors = {}
    for names in ((), ("overflow",), ("overflow", "linear outflow")):
        fit, effects = fit_pieces(pieces, names)
        own = torch.from_numpy(fit.parameters)[None]
        errors[names] = score(own, scored, effects)["validation"]
    assert [*errors.values()] == pytest.approx([0.686, 0.557, 0.290], rel=0.1)
