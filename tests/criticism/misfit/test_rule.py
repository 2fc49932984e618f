"""What helps and what is the cause, on errors that are given."""

import numpy as np
import pytest

from sbi_active.criticism.misfit.rule import Compared, Rule
from sbi_active.criticism.misfit.scored import Scored, predicts_better, weights_by_error
from sbi_active.criticism.results import ModelKey


def choose(models, names, equivalent=(), *, timed=True, guessed=None):
    return Compared(Rule(), models, names, timed).choice(equivalent, guessed)


def starts(models, names, *, timed=True):
    return Compared(Rule(), models, names, timed).starts()


WIGGLE = 1 + 0.05 * np.sin(np.arange(8))


def scored(log_p, square, fitted=None):
    """A model whose fit leaves as much as left-out trials do, unless told."""
    square = square if np.ndim(square) else square * WIGGLE
    return Scored(log_p, square, square.mean() if fitted is None else fitted)


def models(**errors):
    """Squared errors and log probabilities by names joined with _."""
    return {
        ModelKey(() if k == "none" else tuple(k.split("_"))): scored(*v)
        for k, v in errors.items()
    }


def test_an_effect_is_named_that_halves_the_error_beyond_the_sensor():
    several = models(none=(0.0, 101.0, 91.0), a=(20.0, 11.0, 10.0), b=(1.0, 90.0))
    found = choose(several, "ab")
    assert found.key == ModelKey(("a",))
    own = found.support["a"]
    assert own.remains == pytest.approx(0.1)  # of the fit, not of left-out trials
    assert own.gained == pytest.approx(20.0)
    assert found.named == ("a",)
    assert own.inclusion > 0.99
    assert own.better > 0.99
    barely = several | models(a=(20.0, 30.0, 1 + 0.26 * 90))
    assert choose(barely, "ab").key == ModelKey(("a",))
    assert choose(barely, "ab").named == ()
    faint = several | models(a=(4.5, 11.0, 10.0))  # a Bayes factor of 90
    assert choose(faint, "ab").named == ()


def test_what_is_named_does_not_depend_on_the_declared_sensor():
    """Ten times finer, every error is a hundred times as many sensor variances."""
    errors = {"none": (0.0, 1e4), "a": (30.0, 1e3), "b": (1.0, 9e3)}
    finer = {name: (log_p, 100 * square) for name, (log_p, square) in errors.items()}
    names = [choose(models(**own), "ab").named for own in (errors, finer)]
    assert names == [("a",), ("a",)]


def test_effects_that_explain_nothing_change_nothing():
    several = models(none=(0.0, 101.0), a=(20.0, 12.0), b=(-1.0, 101.0))
    more = several | models(c=(-1.0, 101.0), d=(-1.0, 101.0))
    few, many = choose(several, "ab"), choose(more, "abcd")
    assert few.named == many.named == ("a",)
    assert few.support["a"] == many.support["a"]


def test_formulas_in_the_place_of_an_effect_compete_with_it():
    several = models(none=(0.0, 101.0), a=(20.0, 2.0), b=(19.0, 2.1), a_b=(39.0, 1.1))
    asked = []

    def guessed(key, name):
        asked.append((key.effects, name))
        return {"a": -np.inf, "b": 12.0}[name]

    without = choose(several, "ab")
    found = choose(several, "ab", guessed=guessed)
    assert without.key == found.key == ModelKey(("a", "b"))
    assert asked == [(("a", "b"), "a"), (("a", "b"), "b")]
    assert without.named == ("a", "b")
    assert found.named == ("a",)


def test_one_trial_far_from_the_others_does_not_rule_a_model_out():
    """The likelier model has the larger mean square, by one trial of eight."""
    even, far = 4 * WIGGLE, 4 * WIGGLE[::-1].copy()
    far[0] = 60.0
    several = models(none=(0.0, 101.0), b=(0.0, 4.0)) | {
        ModelKey(("b",)): scored(0.0, even),
        ModelKey(("a",)): scored(8.0, far),
    }
    assert far.mean() > 2 * even.mean()
    assert predicts_better(even, far) < 0.9
    assert choose(several, "ab").key == ModelKey(("a",))
    worse = {**several, ModelKey(("a",)): scored(8.0, 2 * even)}
    assert choose(worse, "ab").key == ModelKey(("b",))


@pytest.mark.parametrize("timed", [True, False])
def test_errors_below_the_sensor_s_are_all_alike(timed):
    """A stand-in happens to predict to half of the sensor's error, the cause to it."""
    several = models(none=(0.0, 101.0), a=(40.0, 0.99), b=(20.0, 0.25))
    assert choose(several, "ab", timed=timed).key == ModelKey(("a",))
    above = models(none=(0.0, 101.0), a=(28.0, 9.9), b=(20.0, 2.5))
    assert choose(above, "ab", timed=timed).key == ModelKey(("b",))


def test_an_effect_that_does_not_predict_better_is_dropped():
    several = models(none=(0.0, 50.0), a=(20.0, 10.0), a_b=(25.0, 9.9), b=(0.0, 50.0))
    uneven = 10.0 * np.array([0.8, 1.3, 0.9, 1.2, 0.7, 1.1, 1.0, 0.9])
    several[ModelKey(("a", "b"))] = scored(25.0, uneven)
    found = choose(several, "ab")
    assert found.key == ModelKey(("a",))
    assert found.inclusion["b"] > 0.9


def test_nothing_helps_where_left_out_trials_are_predicted_alike():
    found = choose(models(none=(0.0, 50.0), a=(-1.0, 50.0), b=(0.5, 50.0)), "ab")
    assert found.key == ModelKey()
    assert found.support == {}


def test_effects_that_nothing_separates_share_their_mass():
    several = models(none=(0.0, 101.0), a=(60.0, 11.0), b=(60.0, 11.0))
    apart = choose(several, "ab")
    assert apart.inclusion["a"] == pytest.approx(0.5)
    together = choose(several, "ab", [frozenset("ab")])
    assert len(together.key.effects) == 1
    (name,) = together.key.effects
    assert together.named == (name,)
    assert together.support[name].inclusion == pytest.approx(1.0, abs=1e-6)
    assert apart.support["a"].inclusion == pytest.approx(0.5, abs=1e-6)


def test_what_left_out_trials_do_not_tell_apart_is_listed_in_its_place():
    """A relative is less probable, and predicts as well; the third effect does not."""
    several = models(none=(0.0, 101.0), a=(0.0, 50.0), b=(0.0, 50.0), c=(0.0, 95.0))
    several |= models(c_a=(40.0, 4.0), c_b=(0.0, 4.05), a_b=(0.0, 30.0))
    several = {
        ModelKey(tuple(n for n in "abc" if n in key.effects)): own
        for key, own in several.items()
    }
    near = several[ModelKey(("b", "c"))].square[::-1].copy()
    several[ModelKey(("b", "c"))] = scored(0.0, near)
    found = choose(several, "abc")
    assert found.key == ModelKey(("a", "c"))
    assert found.instead == {"a": ("b",)}
    worse = {**several, ModelKey(("b", "c")): scored(0.0, 8.0)}
    assert choose(worse, "abc").instead == {}


def test_relatives_together_more_likely_than_the_set_without_are_in_the_top():
    """Each is less probable than c alone, one of both is more probable than it."""
    several = models(none=(0.0, 101.0), a=(0.0, 30.0), b=(0.0, 30.0), c=(20.2, 4.4))
    several |= models(a_c=(19.9, 4.0), b_c=(20.0, 4.0))
    tops = [ModelKey(("c",)), ModelKey(("b", "c"))]
    assert starts(several, "abc") == tops
    assert choose(several, "abc").key == ModelKey(("b", "c"))
    apart = {**several, ModelKey(("a", "c")): scored(19.9, 4.4)}  # no relative of b
    assert choose(apart, "abc").key == ModelKey(("c",))


def test_a_model_that_is_far_more_probable_is_admitted_whatever_its_error():
    """Two that imitate a cause predict a few left-out trials better."""
    several = models(none=(0.0, 101.0), b=(0.0, 50.0), c=(0.0, 50.0), b_c=(20.0, 4.0))
    near, far = (models(a=(20.0 + gain, 9.0)) for gain in (9.0, 11.0))
    assert choose(several | near, "abc").key == ModelKey(("b", "c"))
    assert choose(several | far, "abc").key == ModelKey(("a",))


def test_a_third_effect_needs_decisive_evidence():
    several = models(none=(0.0, 101.0), a=(5.0, 60.0), b=(5.0, 60.0), c=(5.0, 60.0))
    several |= models(a_b=(20.0, 10.0), a_c=(10.0, 50.0), b_c=(10.0, 50.0))
    few, many = (models(a_b_c=(20.0 + gain, 9.5)) for gain in (4.0, 5.0))
    assert starts(several | few, "abc")[0] == ModelKey(("a", "b"))
    assert starts(several | many, "abc")[0] == ModelKey(("a", "b", "c"))


def test_the_probability_of_a_better_prediction_is_that_of_a_t_test():
    one, other = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 3.0, 5.0, 4.5])
    assert predicts_better(one, other) > 0.9
    assert predicts_better(one, other) == pytest.approx(1 - predicts_better(other, one))
    few = predicts_better(np.append(one, np.nan), np.append(other, 1.0))
    assert few == pytest.approx(predicts_better(one, other))


def test_what_is_missed_least_is_dropped_first():
    """Beside a useless c, b looks useless by a t test, for one trial tells of it."""
    several = models(none=(0.0, 90.0), a=(1.0, 60.0), b=(1.0, 70.0), a_b=(20.0, 10.0))
    even = np.full(8, 10.0)
    uneven, one = even.copy(), 0.75 * even
    uneven[:4] *= 1.1
    one[0] = 200.0
    several |= {
        ModelKey(("c",)): scored(0.0, 88.0),
        ModelKey(("b", "c")): scored(0.0, 66.0),
        ModelKey(("a", "b", "c")): scored(25.0, even),
        ModelKey(("a", "b")): scored(20.0, uneven / 1.04),
        ModelKey(("a", "c")): scored(0.0, one),
    }
    better_b = predicts_better(even, one)
    assert better_b < predicts_better(even, uneven / 1.04) < 0.8
    assert choose(several, "abc").key == ModelKey(("a", "b"))


def test_what_doubles_the_error_helps_whatever_a_t_test_says():
    """One trial of four tells of the effect, by a hundred times the error."""
    with_it = scored(20.0, np.array([10.0, 10.0, 10.0, 10.0]))
    without = scored(0.0, np.array([9.0, 9.5, 9.0, 1000.0]))
    several = {ModelKey(): without, ModelKey(("a",)): with_it}
    assert predicts_better(with_it.square, without.square) < 0.8
    assert choose(several, "a").key == ModelKey(("a",))
    mild = scored(0.0, np.array([9.0, 9.5, 9.0, 30.0]))
    assert choose({**several, ModelKey(): mild}, "a").key == ModelKey()


def test_a_model_that_predicts_left_out_trials_worse_is_not_admitted():
    """A fast effect has the evidence, a slow one beside it the prediction."""
    found = choose(
        models(none=(0.0, 80.0), a=(60.0, 75.0), b=(2.0, 40.0), a_b=(61.0, 20.0)), "ab"
    )
    assert [*found.probabilities] == [ModelKey(("a", "b"))]
    assert found.key == ModelKey(("a", "b"))
    assert found.named == ()  # beside b, a leaves half of the excess
    assert found.support["a"].better > 0.5


def test_without_a_time_axis_a_model_within_a_fifth_is_compared_and_no_other():
    even, far = 4 * WIGGLE, 4 * WIGGLE[::-1].copy()
    far[0] = 60.0
    several = models(none=(0.0, 101.0), b=(0.0, 4.0)) | {
        ModelKey(("b",)): scored(0.0, even),
        ModelKey(("a",)): scored(8.0, far),
    }
    assert choose(several, "ab", timed=False).key == ModelKey(("b",))
    near = {**several, ModelKey(("a",)): scored(8.0, 1.18**2 * even)}
    assert choose(near, "ab", timed=False).key == ModelKey(("a",))
    assert choose(near, "ab").key == ModelKey(("b",))  # surely worse


def test_a_second_effect_needs_a_bayes_factor_of_five_without_a_time_axis():
    several = models(none=(0.0, 101.0), a=(20.0, 10.0), b=(5.0, 60.0))
    few, many = (several | models(a_b=(20.0 + gain, 9.5)) for gain in (1.5, 1.7))
    assert starts(few, "ab", timed=False)[0] == ModelKey(("a",))
    assert starts(many, "ab", timed=False)[0] == ModelKey(("a", "b"))
    assert starts(few, "ab")[0] == ModelKey(("a", "b"))


# Weights of models by their errors on left-out trials


BARE, ONE, TWO = ModelKey(), ModelKey(("one",)), ModelKey(("two",))
EQUAL = {BARE: 0.0, ONE: 0.0, TWO: 0.0}


def test_each_part_counts_as_one_number_with_an_error_of_unknown_size():
    error = {BARE: np.full(10, 4.0), ONE: np.full(10, 2.0), TWO: np.full(10, 2.0)}
    found = weights_by_error(error, EQUAL, seed=0)
    assert found[ONE] == pytest.approx(found[TWO])
    assert found[ONE] / found[BARE] == pytest.approx(2.0**5)
    assert [*found][-1] == BARE
    assert sum(found.values()) == pytest.approx(1.0)


def test_prior_probabilities_count():
    error = {BARE: np.full(10, 2.0), ONE: np.full(10, 2.0)}
    found = weights_by_error(error, {BARE: np.log(3.0), ONE: 0.0}, seed=0)
    assert found[BARE] == pytest.approx(0.75)


def test_no_model_wins_by_one_part_alone():
    """At the errors' mean the weight would be 1 / (1 + 1.9^-3.5) = .90."""
    error = {BARE: np.r_[np.ones(6), 8.0], ONE: np.r_[np.full(6, 1.05), 1.0]}
    of_the_mean = 1 / (1 + (error[ONE].mean() / error[BARE].mean()) ** 3.5)
    found = weights_by_error(error, {BARE: 0.0, ONE: 0.0}, seed=0)
    assert 0.5 < found[ONE] < of_the_mean - 0.05


def test_parts_that_do_not_count_change_nothing():
    error = {BARE: np.array([1.0, 2.0, 3.0]), ONE: np.array([2.0, 1.0, 2.0])}
    more = {key: np.r_[np.nan, square] for key, square in error.items()}
    one = weights_by_error(error, EQUAL, seed=0)
    assert weights_by_error(more, EQUAL, seed=0) == one
