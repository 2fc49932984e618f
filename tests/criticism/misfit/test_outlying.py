"""One trial that errs far more than the others, where every model misses."""

import torch

from sbi_active.criticism import Criticism, Trials
from tests.criticism.misfit.oscillator import ACTION, EFFECTS, MODEL, PRIOR, TIMES
from tests.criticism.misfit.oscillator import trials as recorded

SLIP = 1.0


def loop(own):
    return Criticism(MODEL, PRIOR, own, effects=EFFECTS[2:], seed=0)


def test_it_is_named_and_has_no_part_in_the_verdict():
    own = recorded(lag=0.3, hidden=0.6)
    x = own.x.clone()
    x[3] += SLIP * torch.sin(3 * TIMES)
    made = loop(Trials(ACTION, x, sample_times=TIMES))
    report = made.report(plan=False, evaluate=False)
    assert [trial.name for trial in report.tracing.set_aside] == ["3"]
    assert "trial 3 is set aside" in str(report).splitlines()[0]
    assert any("trial 3 is far outside" in w for w in report.warnings)
    others = [k for k in range(len(own)) if k != 3]
    alone = loop(own.select(others)).trace()
    assert report.tracing.verdict == alone.verdict
    assert report.tracing.probabilities == alone.probabilities
    lines = str(report).split("By trial")[1].splitlines()
    assert next(line for line in lines if "set aside" in line).split()[0] == "3"


def test_ordinary_misfit_sets_nothing_aside():
    found = loop(recorded(lag=0.3, hidden=0.6))
    assert found.misfit() is not None
    assert found.set_aside == ()
