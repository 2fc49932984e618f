"""Sets of several effects, against all sets of a linear world."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.steps.tracing import log_prior
from tests.criticism.steps import linear_world
from tests.criticism.steps.linear_world import ACTION, judged, measured, rivals


@pytest.mark.parametrize("size", [2, 3])
def test_sets_of_several_effects_have_together_a_third_of_the_next_smaller(size):
    prior = {"none": 0.6, "a": 0.1, "b": 0.2, "c": 0.05, "d": 0.05}
    log_p = {name: float(np.log(p)) for name, p in prior.items()}
    sets = combinations("abcd", size)
    total = sum(np.exp(log_prior(names, log_p)) for names in sets)
    assert total == pytest.approx(0.4 * 3.0 ** (1 - size))


def test_a_name_may_contain_what_joins_names():
    x = measured(curve=0.5, kink=0.6)
    shapes = rivals(x).effects
    renamed = [replace(e, name=f"{n} + {n} lag") for n, e in shapes.items()]
    some = RivalSet(rivals(x).model, linear_world.PRIOR, Trials(ACTION, x), renamed)
    tracing, _ = traced(judged(some), None)
    assert tracing.chosen == ("curve + curve lag", "kink + kink lag")
    assert tracing.model == "curve + curve lag + kink + kink lag"
    assert tracing.inclusion["wave + wave lag"] < 0.2
    assert not tracing.has_several("wave + wave lag")
    assert tracing.has_several(tracing.model)
