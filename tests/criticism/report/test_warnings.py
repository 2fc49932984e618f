"""Every caution from a report that deserves it, and not from one that comes near."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sbi_active import SimulatorModel
from sbi_active.criticism import Trials, close_loop
from sbi_active.criticism.contradictions import (
    BoundParameter,
    Bounds,
    MissedTrial,
    OutlyingTrial,
)
from tests.criticism import slope_world
from tests.criticism.report import reports
from tests.effects import BIAS, autocorrelated, drift


def noted(**changes):
    return {"detection": replace(reports.MADE.detection, **changes)}


def told(verdict="drag", **changes):
    return {"tracing": reports.tracing(verdict, **changes)}


def with_evidence(**changes):
    drag = replace(reports.MADE.tracing.evidences["drag"], **changes)
    return told(evidences=reports.MADE.tracing.evidences | {"drag": drag})


def with_noise(kind):
    return {"residuals": replace(reports.residuals(size=6.0), noise=kind)}


def smooth(correlation, times=None, *, known=0.0):
    """Return residuals along 40 samples with an autocorrelated error."""
    z = autocorrelated(np.random.default_rng(0).normal(size=(8, 40)), correlation)
    made = replace(reports.residuals((40,), times=times), refitted=z, correlation=known)
    return {"residuals": made, "residuals_after": made}


def outcomes(lost, probability):
    made = reports.residuals()
    x = made.x.copy()
    x[lost] = np.nan
    found = replace(made, x=x, probability_valid=np.array(probability))
    return {"residuals": found, "residuals_after": found}


def repeated(share):
    """Return residuals along 40 samples, a share of whose variance is that of all."""
    drawn = np.random.default_rng(0).normal(size=(9, 40))
    z = share**0.5 * drawn[:1] + (1 - share) ** 0.5 * drawn[1:]
    made = replace(reports.residuals((40,), times=np.arange(40.0)), refitted=z)
    return {"residuals": made, "residuals_after": made}


def jumps(size):
    made = reports.residuals()
    found = replace(made, roughness=None if size is None else np.full((8, 6), size))
    return {"residuals": found, "residuals_after": found}


def pushed(mean):
    """Return a report whose drag lies so many prior deviations from its null."""
    evidence = reports.MADE.tracing.evidences["drag"]
    draws = evidence.draws.copy()
    draws[:, -1] += mean - draws[:, -1].mean()
    return with_evidence(draws=draws)


def errors(after):
    table = reports.MADE.evaluation.table.copy()
    table.loc[table["metric"] == "rmse", ["before", "after"]] = 1.0, after
    return {"evaluation": replace(reports.MADE.evaluation, table=table)}


def growing(rate):
    made = reports.residuals(num=9)
    z = made.refitted * np.exp(rate * np.arange(9))[:, None]
    grown = replace(made, refitted=z, x=2 + z)
    own = reports.trials(reports.SHUFFLED)
    return {"residuals": grown, "residuals_after": grown, "trials": own}


def forced(*, taken):
    def with_force(theta, action, *, force=None):
        return theta[:, :1] * torch.ones(1, 6)

    fn = with_force if taken else lambda theta, action: with_force(theta, action)
    return told("unexplained") | {"simulator": SimulatorModel(fn)}


MISSED = MissedTrial(position=0, name="7", size=60.0, p_value=0.0, by_both=True)
ASIDE = OutlyingTrial(position=3, name="3", times=9.0)
BOUND = BoundParameter(name="mu_1", model="none", side="lower", bound=0.5, beyond=0.4)
EACH = np.arange(40.0)  # times of the samples
WITHDRAWN = {"instead_of": "drag", "refuted": (1.0, 2.0)}
WEAK = {"log_bayes_factor": 1.0, "p_value": 1e-9}
SORTED = reports.trials(sorted(reports.trials().action[:, 0].tolist()))
UNORDERED = Trials(SORTED.action, SORTED.x, order="unknown")
SMALL = {"lower_p_value": 1e-9, "chi_square": 1.0}
FIVE = reports.trials([2.0, -1.0, 3.0, 1.0, -2.0])

#: By code, and words where it has two kinds: a report that deserves it, and one that
#: comes near.
CASES = {
    "SA501": (with_noise("estimated"), with_noise("declared")),
    "SA502": ({"trials": FIVE[:4]}, {"trials": FIVE}),
    "SA503": ({"trials": SORTED}, {"trials": UNORDERED}),
    "SA504": ({"designed": True}, {}),
    "SA505 gave no measurement": (outcomes([3], [1.0] * 8), outcomes([], [1.0] * 8)),
    "SA505 gave a measurement": (outcomes([], [0.0] * 8), outcomes([], [0.5] * 8)),
    "SA506": (jumps(0.2), jumps(None)),
    "SA507 sample_times": (smooth(0.95), smooth(0.0)),
    "SA507 AutocorrelatedNoise": (smooth(0.95, EACH), smooth(0.95, EACH, known=0.9)),
    "SA509": (noted(**WEAK), noted(**WEAK | {"p_value": 0.02})),
    "SA510": (told(p_value=1e-4), told(p_value=0.1)),
    "SA512 does not lower": (errors(1.1), errors(0.9)),
    "SA512 is not named": (told("unexplained", **WITHDRAWN), told()),
    "SA513": (told(set_aside=(ASIDE,)), told()),
    "SA514": ({"evaluation": replace(reports.MADE.evaluation, missed=(MISSED,))}, {}),
    "SA515": (pushed(3.0), pushed(2.0)),
    "SA518": (told("unexplained"), told("scatter")),
    "SA519": (told("scatter"), told("unexplained")),
    "SA520": ({"exploratory": True}, {}),
    "SA521": (told("outlier", outliers={3.0: 0.95}), told(outliers={3.0: 0.95})),
    "SA522": (told(needed=(3.0,)), told(needed=(3.0, 5.0))),
    "SA523": (noted(**SMALL), noted(lower_p_value=0.1, chi_square=30.0)),
    "SA103": (told(bounds=Bounds(parameters=(BOUND,))), told()),
    "SA529": (growing(0.4), growing(0.0)),
    "SA534": (repeated(0.5) | told("none"), repeated(0.0) | told("none")),
    "SA530": (forced(taken=True), forced(taken=False)),
}


@pytest.mark.parametrize("kind", [*CASES])
def test_each_caution_has_its_case(kind):
    code, _, words = kind.partition(" ")

    def said(made):
        return [w for w in made.warnings if w.code == code and words in w]

    deserved, near = CASES[kind]
    made = reports.report(**deserved)
    (sentence,) = said(made)
    text = sentence.removesuffix(f" ({code})")
    assert f"- {code} {text}" in " ".join(str(made).split())
    assert not said(reports.report(**near))
    assert reports.report().warnings == ()  # of a right model


def test_trials_of_unknown_order_drift_nowhere():
    action = torch.linspace(-2, 2, 16)[:, None]
    own = Trials(action, slope_world.read(action + 0.8, 1), order="unknown")
    effects = [BIAS, drift(0.1, needs_order=True)]
    given = slope_world.MODEL, slope_world.PRIOR, own
    made = close_loop(*given, effects=effects, evaluate=False)
    assert "SA526" in [w.code for w in made.warnings]
    assert "drift" not in made.probabilities
    assert made.verdict == "bias"
