"""How a verdict over forces of the dictionary is told."""

from dataclasses import replace

import numpy as np

from sbi_active.criticism.results import NextAction
from tests.criticism.report.reports import estimate, evidence, report, tracing

FORMS = {"sin 2q of hinge": 0.5, "q^3 of hinge": 0.3, "v of hinge": 0.1}
IN_Q = "force in q of hinge"


def forces(**changes):
    families = dict.fromkeys(FORMS, IN_Q) | {"v of hinge": "force in v of hinge"}
    return tracing(
        verdict="sin 2q of hinge",
        chosen=("sin 2q of hinge",),
        probabilities={**FORMS, "none": 0.1},
        inclusion=dict(FORMS),
        credible_set=(*FORMS,),
        estimates=tuple(
            estimate(n, p, family=families[n], describe="") for n, p in FORMS.items()
        ),
        evidences={n: evidence(n, -3.0) for n in ["none", *FORMS]},
        **changes,
    )


def first_line(found):
    return str(report(tracing=found)).splitlines()[0]


def test_the_family_is_named_where_no_form_has_nine_tenths():
    line = first_line(forces())
    assert line.startswith(f"Verdict: {IN_Q} (P = 0.80), form open: ")
    assert "sin 2q of hinge (P = 0.50), q^3 of hinge (P = 0.30)" in line
    rest = {"none": 0.03, "q^3 of hinge": 0.01, "v of hinge": 0.01}
    certain = replace(forces(), probabilities={"sin 2q of hinge": 0.95, **rest})
    assert first_line(certain).startswith("Verdict: sin 2q of hinge (P = 0.95)")


def test_two_lines_say_what_separates_the_forms():
    action = NextAction(
        action=np.array([0.4]),
        candidates=np.array([[0.4], [2.0]]),
        information_gain=np.array([0.05, 0.6]),
        separates=(*FORMS,),
        within=np.array([0.4]),
        within_gain=0.05,
        beyond=np.array([2.0]),
        beyond_gain=0.6,
    )
    text = " ".join(str(report(tracing=forces(), next_action=action)).split())
    assert "within the range tried, speed = 0.4 m/s: at least 0.05 nats between" in text
    assert "beyond the range tried, speed = 2 m/s: at least 0.60 nats between" in text
