"""Sets of several effects, against all sets of a linear world."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.combinations import grow, log_prior
from sbi_active.criticism.steps.detection import THRESHOLD, detect
from sbi_active.criticism.steps.sampled import Sampled
from sbi_active.criticism.steps.tracing import log_priors, trace
from tests.criticism.steps import linear_world
from tests.criticism.steps.linear_world import ACTION, SHAPES, measured, rivals


@pytest.mark.parametrize("size", [2, 3])
def test_sets_of_several_effects_have_together_a_third_of_the_next_smaller(size):
    prior = {"none": 0.5, "unexplained": 0.1, "a": 0.1, "b": 0.2, "c": 0.05, "d": 0.05}
    log_p = {name: float(np.log(p)) for name, p in prior.items()}
    sets = combinations("abcd", size)
    total = sum(np.exp(log_prior(names, log_p)) for names in sets)
    assert total == pytest.approx(0.4 * 3.0 ** (1 - size))


def grown(x):
    """Return what is grown, the models, and the log priors of single effects."""
    some = rivals(x)
    prior = log_priors([*some.effects.values()])
    singles = {
        n: prior[n] + log_evidence(some, ModelKey((n,)))[0] for n in some.effects
    }
    return grow(some, singles, prior), some, prior


def worthy_sets(x):
    """Return sets with a Bayes factor above 20 against each of their parts."""
    found = []
    for size in (2, 3):
        for names in combinations(SHAPES, size):
            parts = combinations(names, size - 1)
            best = max(linear_world.log_evidence(x, part) for part in parts)
            if linear_world.log_evidence(x, names) - best > THRESHOLD:
                found.append(names)
    return found


@pytest.mark.parametrize(
    "phi",
    [
        {"curve": 0.5, "wave": 0.5},
        {"wave": 0.6, "kink": -0.6},
        {"curve": 0.5, "wave": 0.5, "kink": 0.6},
    ],
    ids=" ".join,
)
def test_what_grows_are_the_sets_that_pay_for_each_of_their_effects(phi):
    x = measured(**phi)
    found, some, prior = grown(x)
    worthy = worthy_sets(x)
    assert tuple(phi) in worthy
    # Once a set fits, no set far behind it is added to.
    assert {*found} <= {ModelKey(names) for names in worthy}
    assert max(found, key=found.__getitem__) == ModelKey((*phi,))
    for key, value in found.items():
        exact = linear_world.log_evidence(x, key.effects)
        exact += log_prior(key.effects, prior)
        error = log_evidence(some, key)[1]
        assert error < 0.2
        assert value == pytest.approx(exact, abs=4 * error)


def test_a_name_may_contain_what_joins_names():
    x = measured(curve=0.5, kink=0.6)
    shapes = rivals(x).effects
    renamed = [replace(e, name=f"{n} + {n} lag") for n, e in shapes.items()]
    some = RivalSet(rivals(x).model, linear_world.PRIOR, Trials(ACTION, x), renamed)
    tracing = trace(Sampled(some), detect(some), compare=False)
    assert tracing.chosen == ("curve + curve lag", "kink + kink lag")
    assert tracing.verdict == "curve + curve lag + kink + kink lag"
    assert tracing.inclusion["wave + wave lag"] < 0.2
    assert not tracing.has_several("wave + wave lag")
    assert tracing.has_several(tracing.verdict)
