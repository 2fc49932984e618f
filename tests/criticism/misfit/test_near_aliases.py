"""Effects that the noise hides from each other."""

import torch

from sbi_active import DiscreteActions
from sbi_active.criticism.misfit import record
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.detection import THRESHOLD
from tests.criticism.steps.linear_world import NOISE, judged, measured, rivals
from tests.effects import on_outcomes

SIZE = 0.5
X = measured(curve=SIZE)
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 12))
PAIR = frozenset({"curve", "twin"})


def near_aliases(some, actions, known=()):
    found = judged(some)
    log_z = {n: found.states.log_evidence(ModelKey((n,))) for n in some.effects}
    return record.near_aliases(found.search, log_z, actions, known)


def twin(distance):
    """Return the curve with a wave of a root mean square, in noise deviations."""
    size = distance * NOISE / SIZE * 2**0.5
    return on_outcomes(
        "twin",
        lambda x, phi, action, context: (
            x + phi * (action**2 - 1 + size * torch.sin(5 * action))
        ),
    )


def test_effects_closer_than_the_noise_are_nearly_the_same():
    assert near_aliases(rivals(X, twin(0.3)), ACTIONS) == (PAIR,)


def test_effects_apart_by_more_over_the_permitted_actions_are_not():
    # Between the trials at hand they hardly differ; beyond them they do.
    other = on_outcomes(
        "twin",
        lambda x, phi, action, context: (
            x + phi * (action**2 - 1 + torch.relu(action.abs() - 2) ** 3)
        ),
    )
    some = rivals(X, other)
    assert near_aliases(some, None) == (PAIR,)
    assert near_aliases(some, DiscreteActions(torch.linspace(-4, 4, 12))) == ()


def test_an_effect_that_the_trials_refute_has_no_alias():
    assert near_aliases(rivals(X), ACTIONS) == ()
    # Closer than the noise, and yet refuted by these trials.
    some = rivals(measured(curve=SIZE, seed=4), twin(0.95))
    states = judged(rivals(measured(curve=SIZE, seed=4), twin(0.95))).states
    curve, other = (states.log_evidence(ModelKey((n,))) for n in ("curve", "twin"))
    assert curve - other > THRESHOLD
    assert near_aliases(some, ACTIONS) == ()
