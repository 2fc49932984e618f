"""The benchmark's tables, from rows whose scores are known."""

import argparse
import json

import numpy as np
import pytest

from benchmarks.criticism import tables
from benchmarks.criticism.curves import Curves
from benchmarks.criticism.worlds import get_world


def row(case: int, effects: str, verdict: str, strength: float, **changes) -> dict:
    stated = changes.pop("probabilities", {verdict: 0.9, "none": 0.1})
    made = {
        "case": str(case),
        "effects": effects,
        "strengths": "1.5",
        "correlation": "0",
        "lambda": str(strength),
        "support": "",
        "verdict": verdict,
        "probabilities": json.dumps(stated),
        "credible_set": json.dumps([verdict]),
        "equivalent": "[]",
        "formula": "",
        "undeclared": "0",
        "rmse_before": "2.0",
        "rmse_after": "1.0",
        "rmse_oracle": "0.8",
        "coverage_before": "0.5",
        "coverage_after": "0.875",
        "cpu_seconds": "3.0",
        "trial_simulations": "70000",
        "failure": "",
    }
    return made | changes


def table(name: str, rows: dict[str, list[dict]], world: str = "A") -> str:
    found = {(kind, False): these for kind, these in rows.items()}
    return "\n".join(tables.summary(name, get_world(world), found))


def test_a_false_alarm_is_any_verdict_on_clean_data():
    rows = [row(i, "none", "none", 0.0) for i in range(19)]
    rows.append(row(19, "none", "drift", 0.0))
    text = table("loop", {"clean": rows})
    assert "false alarms 0.050 (1/20)" in text
    assert "case 19: drift" in text


def test_power_and_tracing_count_equivalents_as_one():
    rows = [
        row(0, "bias", "action offset", 100.0),
        row(1, "drift", "drift", 50.0),
        row(2, "quadratic", "none", 40.0),
        row(3, "gain", "none", 0.0),
        row(4, "noise inflation", "scatter", 0.0),
        row(5, "quadratic", "drift", 15.0, probabilities={"drift": 1.0}),
    ]
    text = table("loop", {"library": rows})
    assert "lambda in 25-inf: 0.667 (2/3)" in text
    assert "missed case 2 (lambda 40)" in text
    assert "lambda in 10-25: 1.000 (1/1)" in text
    assert "lambda in 0-10: 0.000 (0/1)" in text
    assert "top-1 1.000 (2/2)" in text
    assert "called scatter 1.000 (1/1)" in text
    assert "RMSE after/before, detected sets: median 0.50" in text
    assert "RMSE after/oracle: median 1.250" in text


def test_second_place_counts_for_top_2_alone():
    stated = {"none": 0.5, "drift": 0.3, "quadratic": 0.2}
    rows = [row(0, "quadratic", "drift", 90.0, probabilities=stated)]
    text = table("loop", {"library": rows})
    assert "top-1 0.000 (0/1)" in text
    assert "top-2 1.000 (1/1)" in text
    assert "quadratic 1.5 called drift" in text


def test_hidden_effects_have_a_line_each():
    pytest.importorskip("mujoco")
    same = json.dumps([["none", "time stamp"]])
    rows = [
        row(0, "aim", "center of mass", 90.0, equivalent=same),
        row(1, "aim", "aim", 20.0, equivalent=same),
        row(2, "aim", "none", 30.0),
        row(3, "tilt", "none", 1.0, equivalent=same),
    ]
    text = table("loop", {"library": rows}, "D")
    assert (
        "aim: detected 2 of 3, lambda > 25 1 of 2; called center of mass 1, aim 1"
        in text
    )
    assert "tilt: detected 0 of 1, lambda > 25 0 of 0; called -" in text
    assert "inseparable in the report: none = time stamp, 3 of 4" in text


def test_failures_are_counted_apart():
    rows = [row(0, "none", "none", 0.0), row(1, "none", "", 0.0, failure="ValueError")]
    text = table("loop", {"clean": rows})
    assert "failed 1: ValueError" in text
    assert "false alarms 0.000 (0/1)" in text


def test_calibration_needs_both_kinds():
    clean = [row(0, "none", "none", 0.0, probabilities={"none": 0.9, "drift": 0.1})]
    rows = {"clean": clean, "library": [row(1, "bias", "drift", 50.0)]}
    text = table("loop", rows)
    assert "covers 0.500 (1/2)" in text
    assert "mean stated mass 0.900" in text
    assert "calibration" not in table("loop", {"clean": clean})


def test_what_is_wrongly_called_undeclared_is_counted_where_it_is_known():
    rows = [row(i, "drift", "drift", 50.0, undeclared=str(i % 2)) for i in range(4)]
    title = 'false "something undeclared"'
    assert f"{title} 0.500 (2/4)" in table("loop", {"library": rows})
    older = [each | {"undeclared": ""} for each in rows]
    assert title not in table("loop", {"library": older})


def test_the_right_formula_and_an_alias_are_told_apart():
    rows = [
        row(0, "quadratic", "unexplained", 90.0, formula="xi^2", support="80"),
        row(1, "quadratic", "unexplained", 90.0, formula="|xi|", support="80"),
        row(2, "drift", "quadratic", 90.0, support="9", undeclared="1"),
        row(3, "drift", "quadratic", 20.0, support="9"),
    ]
    text = table("open", {"removed": rows})
    beside = 'the same, or names an effect "beside something undeclared"'
    assert f"{beside} (lambda > 25) 1.000 (3/3)" in text
    assert f"{beside} (all) 0.750 (3/4)" in text
    assert "called quadratic beside something undeclared" in text
    assert "says so (lambda > 25) 0.667 (2/3)" in text
    assert "of those declared leave lambda > 25 1.000 (2/2)" in text
    assert "names the formula (lambda > 25) 0.500 (1/2)" in text
    near = [row(0, "power", "quadratic", 30.0), row(1, "sine", "quadratic", 30.0)]
    text = table("open", {"outside": near})
    assert "no alias in the library 0.000 (0/1)" in text
    assert "near-aliases 1.000 (1/1)" in text


def test_a_pair_is_exact_or_not():
    rows = [
        row(0, "tilt + speed gain", "speed gain + tilt", 90.0, support="60"),
        row(1, "tilt + speed gain", "tilt", 90.0, support="60"),
        row(2, "tilt + speed gain", "tilt + camera bias", 90.0, support="3"),
    ]
    text = table("pairs", {"pair": rows}, "B")
    assert "> 25) 0.500 (1/2)" in text
    assert "false inclusion, all 0.333 (1/3)" in text


@pytest.mark.parametrize("kind", ["clean", "library"])
def test_correlated_errors_are_listed_by_correlation(kind):
    effects = "none" if kind == "clean" else "tilt"
    rows = [
        row(i, effects, "tilt", 90.0, correlation=str(rho))
        for i, rho in enumerate((0.0, 0.0, 0.9))
    ]
    text = table("correlation", {kind: rows}, "C")
    assert "rho 0: " in text
    assert "(2/2)" in text.split("rho 0: ")[1].splitlines()[0]
    assert "(1/1)" in text.split("rho 0.9: ")[1].splitlines()[0]


def test_every_table_has_a_summary_of_each_of_its_kinds():
    from benchmarks.criticism import run

    for name, kinds in run.TABLES.items():
        for kind in kinds:
            assert (name, kind) in tables.SUMMARIES
    asked = argparse.Namespace(table="correlation", kind=None, independent=False)
    assert len([*run.settings(asked)]) == 4


def policy_rows(case: int, policy: str, right: list[bool], strength: float) -> list:
    return [
        row(case, "bias", "bias" if hit else "none", strength)
        | {
            "policy": policy,
            "trials": str(3 + k),
            "top": str(hit),
            "place": "1" if hit else "2",
            "probability": "0.8" if hit else "0.3",
        }
        for k, hit in enumerate(right)
    ]


def test_chosen_trials_are_compared_where_random_ones_show_the_effect():
    rows = []
    for case in (0, 1):
        rows += policy_rows(case, "random", [False, False, False, True], 30.0)
        rows += policy_rows(case, "chosen", [False, case == 0, True, True], 5.0)
    rows += policy_rows(2, "random", [False] * 4, 20.0)  # not shown: left out
    rows += policy_rows(2, "chosen", [False] * 4, 90.0)
    left_out = policy_rows(3, "random", [False], 0.0)[0]
    rows.append(left_out | {"trials": "6", "verdict": "", "cpu_seconds": ""})
    text = table("active", {"library": rows})
    assert "detectable (lambda > 25 with all random trials): 2 of 4 cases" in text
    assert "     4   0.000   0.500  3.0 (0.75)" in text
    assert "     6   1.000   1.000  5.0 (0.83)" in text
    curves = Curves.of(rows)
    assert curves.matched("probability of the truth", 6) == pytest.approx(5.0)
    assert curves.matched("top-1", 6, np.array([0, 0])) == pytest.approx(4.0)


def test_a_level_that_is_never_reached():
    rows = policy_rows(0, "random", [False, True], 30.0)
    rows += policy_rows(0, "chosen", [False, False], 30.0)
    assert "     4   1.000   0.000  not reached" in table("active", {"library": rows})


def test_without_a_detectable_case_there_is_no_curve():
    rows = policy_rows(0, "random", [False, True], 10.0)
    rows += policy_rows(0, "chosen", [False, False], 30.0)
    assert "0 of 1 cases" in table("active", {"library": rows})
