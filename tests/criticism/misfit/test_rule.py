"""What helps and what is the cause, on errors that are given."""

import numpy as np
import pytest

from sbi_active.criticism.misfit.rule import Compared, Rule
from sbi_active.criticism.misfit.scored import Scored, weights_by_error
from sbi_active.criticism.results import ModelKey

WIGGLE = 1 + 0.05 * np.sin(np.arange(8))


def scored(log_p, square, fitted=None):
    """A model whose fit leaves as much as left-out trials do, unless told."""
    square = square if np.ndim(square) else square * WIGGLE
    return Scored(log_p, square, square.mean() if fitted is None else fitted)


def compared(errors, timed=True):
    """Compare models by log probability and squared errors, named by their effects."""
    models = {ModelKey((*k.strip("-"),)): scored(*v) for k, v in errors.items()}
    names = "".join(sorted({n for key in models for n in key.effects}))
    return Compared(Rule(), models, names, timed)


def choice(errors, *, timed=True, equivalent=(), guessed=None):
    return compared(errors, timed).choice(equivalent, guessed)


def one_far(even):
    """Return errors that are as small but for one trial of eight."""
    far = even[::-1].copy()
    far[0] = 60.0
    return far


TEN, EVEN = np.full(8, 10.0), 4 * WIGGLE
FAR = one_far(EVEN)
HALVED = {"-": (0.0, 101.0, 91.0), "a": (20.0, 11.0, 10.0), "b": (1.0, 90.0)}
#: A useless c beside which b looks useless by a t test, for one trial tells of it.
UNEVEN = TEN * [1.1, 1.1, 1.1, 1.1, 1, 1, 1, 1] / 1.04
ONE = np.r_[200.0, 0.75 * TEN[1:]]
DROPPED = {"-": (0.0, 90.0), "a": (1.0, 60.0), "b": (1.0, 70.0), "c": (0.0, 88.0)}
DROPPED |= {"bc": (0.0, 66.0), "abc": (25.0, TEN)}
DROPPED |= {"ab": (20.0, UNEVEN), "ac": (0.0, ONE)}
JITTER = TEN * [0.8, 1.3, 0.9, 1.2, 0.7, 1.1, 1.0, 0.9]
BETTER = {"-": (0.0, 50.0), "a": (20.0, 10.0), "b": (0.0, 50.0), "ab": (25.0, JITTER)}
#: Two that imitate a cause predict a few left-out trials better.
IMITATED = {"-": (0.0, 101.0), "b": (0.0, 50.0), "c": (0.0, 50.0), "bc": (20.0, 4.0)}
#: Each of a and b is less probable than c alone, one of both is more probable than it.
RELATIVES = {"-": (0.0, 101.0), "a": (0.0, 30.0), "b": (0.0, 30.0), "c": (20.2, 4.4)}
RELATIVES |= {"ac": (19.9, 4.0), "bc": (20.0, 4.0)}
FEW = {"-": (0.0, 101.0), "b": (0.0, EVEN)}
SAME = {"-": (0, 50.0), "a": (-1, 50.0), "b": (0.5, 50.0)}
#: One trial of four tells of the effect, by a hundred times the error.
ONCE, MILD = np.array([9.0, 9.5, 9.0, 1000.0]), np.array([9.0, 9.5, 9.0, 30.0])

#: Models, whether trials have times, effects that help, and those that are named.
CASES = {
    "halves the error beyond the sensor": (HALVED, True, "a", "a"),
    "barely not half": (HALVED | {"a": (20.0, 30.0, 1 + 0.26 * 90)}, True, "a", ""),
    "a Bayes factor of 90": (HALVED | {"a": (4.5, 11.0, 10.0)}, True, "a", ""),
    "a sensor": ({"-": (0.0, 1e4), "a": (30.0, 1e3), "b": (1.0, 9e3)}, True, "a", "a"),
    "a finer one": ({"-": (0, 1e6), "a": (30, 1e5), "b": (1, 9e5)}, True, "a", "a"),
    "no error less": (SAME, True, "", ""),
    "one trial far from the others": (FEW | {"a": (8.0, FAR)}, True, "a", None),
    "not without times": (FEW | {"a": (8.0, FAR)}, False, "b", None),
    "surely worse": (FEW | {"a": (8.0, 2 * EVEN)}, True, "b", None),
    "within a fifth": (FEW | {"a": (8.0, 1.18**2 * EVEN)}, False, "a", None),
    "within a fifth, surely": (FEW | {"a": (8.0, 1.18**2 * EVEN)}, True, "b", None),
    "no better prediction": (BETTER, True, "a", None),
    "far more probable": (IMITATED | {"a": (31.0, 9.0)}, True, "a", None),
    "more probable": (IMITATED | {"a": (29.0, 9.0)}, True, "bc", None),
    "relatives together": (RELATIVES, True, "bc", None),
    "no relatives": (RELATIVES | {"ac": (19.9, 4.4)}, True, "c", None),
    "missed least": (DROPPED, True, "ab", None),
    "doubles the error": ({"-": (0.0, ONCE), "a": (20.0, TEN[:4])}, True, "a", None),
    "does not": ({"-": (0.0, MILD), "a": (20.0, TEN[:4])}, True, "", None),
}
#: A stand-in happens to predict to half of the sensor's error, the cause to it.
BELOW = {"-": (0.0, 101.0), "a": (40.0, 0.99), "b": (20.0, 0.25)}
ABOVE = {"-": (0.0, 101.0), "a": (28.0, 9.9), "b": (20.0, 2.5)}
for timed in (True, False):
    CASES[f"errors below the sensor's, {timed}"] = (BELOW, timed, "a", None)
    CASES[f"errors above the sensor's, {timed}"] = (ABOVE, timed, "b", None)


@pytest.mark.parametrize("case", CASES)
def test_what_helps_and_what_is_named(case):
    errors, timed, helps, named = CASES[case]
    found = choice(errors, timed=timed)
    assert found.key == ModelKey((*helps,))
    assert {*found.support} == {*helps}
    if named is not None:
        assert found.named == (*named,)


def test_support_is_of_the_fit_and_needs_no_other_effects():
    own = choice(HALVED).support["a"]
    assert own.remains == pytest.approx(0.1)  # of the fit, not of left-out trials
    assert own.gained == pytest.approx(20.0)
    assert min(own.inclusion, own.better) > 0.99
    more = choice(HALVED | {"b": (-1.0, 101.0)} | dict.fromkeys("cd", (-1.0, 101.0)))
    assert more.named == ("a",)
    assert more.support["a"] == choice(HALVED | {"b": (-1.0, 101.0)}).support["a"]


def test_a_sensor_declared_too_fine_keeps_no_effect_from_being_named():
    """Of the sensor's own error nothing can be left out."""
    for size in (1.0, 100.0):
        models = {
            ModelKey(): Scored(0.0, size * TEN, 4 * size, white=size),
            ModelKey(("a",)): Scored(20.0, size * EVEN, 1.5 * size, white=size),
        }
        found = Compared(Rule(), models, "a").choice()
        assert found.support["a"].remains == pytest.approx(0.5 / 3)
        assert found.named == ("a",)


def test_formulas_in_the_place_of_an_effect_compete_with_it():
    errors = {"-": (0, 101.0), "a": (20, 2.0), "b": (19, 2.1), "ab": (39, 1.1)}
    asked = []

    def guessed(key, name):
        asked.append((key.effects, name))
        return {"a": -np.inf, "b": 12.0}[name]

    found = choice(errors, guessed=guessed)
    assert found.key == ModelKey(("a", "b"))
    assert asked == [(("a", "b"), "a"), (("a", "b"), "b")]
    assert choice(errors).named == ("a", "b")
    assert found.named == ("a",)


def test_effects_that_nothing_separates_share_their_mass():
    errors = {"-": (0.0, 101.0), "a": (60.0, 11.0), "b": (60.0, 11.0)}
    apart, together = choice(errors), choice(errors, equivalent=[frozenset("ab")])
    assert apart.inclusion["a"] == pytest.approx(0.5)
    assert apart.support["a"].inclusion == pytest.approx(0.5, abs=1e-6)
    (name,) = together.key.effects
    assert together.named == (name,)
    assert together.support[name].inclusion == pytest.approx(1.0, abs=1e-6)


def test_what_left_out_trials_do_not_tell_apart_is_listed_in_its_place():
    """A relative is less probable, and predicts as well; the third effect does not."""
    errors = {"-": (0, 101.0), "a": (0, 50.0), "b": (0, 50.0), "c": (0, 95.0)}
    errors |= {"ac": (40, 4.0), "bc": (0, 4.05 * WIGGLE[::-1]), "ab": (0, 30.0)}
    found = choice(errors)
    assert found.key == ModelKey(("a", "c"))
    assert found.instead == {"a": ("b",)}
    assert choice(errors | {"bc": (0.0, 8.0)}).instead == {}


def test_a_model_that_predicts_left_out_trials_worse_is_not_admitted():
    """A fast effect has the evidence, a slow one beside it the prediction."""
    errors = {"-": (0, 80.0), "a": (60, 75.0), "b": (2, 40.0), "ab": (61, 20.0)}
    found = choice(errors)
    assert [*found.probabilities] == [found.key] == [ModelKey(("a", "b"))]
    assert found.named == ()  # beside b, a leaves half of the excess
    assert found.support["a"].better > 0.5


THREE = {"-": (0, 101.0), "a": (5, 60.0), "b": (5, 60.0), "c": (5, 60.0)}
THREE |= {"ab": (20, 10.0), "ac": (10, 50.0), "bc": (10, 50.0)}
TWO = {"-": (0.0, 101.0), "a": (20.0, 10.0), "b": (5.0, 60.0)}


#: Errors, whether trials have times, and what is begun with.
FURTHER = [
    (THREE | {"abc": (24.0, 9.5)}, True, "ab"),
    (THREE | {"abc": (25.0, 9.5)}, True, "abc"),  # decisive
    (TWO | {"ab": (21.5, 9.5)}, False, "a"),
    (TWO | {"ab": (21.7, 9.5)}, False, "ab"),  # five times without times
    (TWO | {"ab": (21.5, 9.5)}, True, "ab"),
]


@pytest.mark.parametrize(("errors", "timed", "first"), FURTHER)
def test_a_further_effect_needs_evidence(errors, timed, first):
    assert compared(errors, timed).starts()[0] == ModelKey((*first,))


# Weights of models by their errors on left-out trials


def test_no_model_wins_by_one_part_alone():
    """At the errors' mean the weight would be 1 / (1 + 1.9^-3.5) = .90."""
    bare, one = np.array([1.0] * 6 + [8.0]), np.array([1.05] * 6 + [1.0])
    errors = {ModelKey(): bare, ModelKey(("a",)): one}
    found = weights_by_error(errors, dict.fromkeys(errors, 0.0), seed=0)
    of_the_mean = 1 / (1 + (one.mean() / bare.mean()) ** 3.5)
    assert 0.5 < found[ModelKey(("a",))] < of_the_mean - 0.05
    uncounted = {key: np.append(own, np.nan) for key, own in errors.items()}
    assert weights_by_error(uncounted, dict.fromkeys(errors, 0.0), seed=0) == found
    alike, prior = dict.fromkeys(errors, bare), {ModelKey(): np.log(3)}
    found = weights_by_error(alike, dict.fromkeys(errors, 0.0) | prior, seed=0)
    assert found[ModelKey()] == pytest.approx(0.75)
