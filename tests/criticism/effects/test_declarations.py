"""What a declared effect must be: its parts, its null, its prior, what apply gives."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal, LogNormal, Normal, Uniform

from sbi_active import Campaign, DiscreteActions, SimulatorModel
from sbi_active.criticism import (
    AugmentedSimulator,
    Context,
    Criticism,
    Trials,
    generic_effects,
    joint_prior,
)
from sbi_active.criticism.effects.effect import require_nested
from tests.criticism.slope_world import MODEL, PRIOR
from tests.effects import effect

NAN, NORMAL = float("nan"), Normal(0.0, 1.0)
SPEED = torch.tensor([1.0, 2.0, 3.0, 2.0, 1.5])
STOP = 0.7 * SPEED + 0.1 * torch.tensor([0.3, -1.2, 0.8, 0.1, -0.4])
ACTIONS = DiscreteActions([1.0, 1.5, 2.0, 3.0])


def loop(*effects, model=MODEL):
    return Criticism(model, PRIOR, Trials(SPEED, STOP), effects=effects)


#: Parts that are none, and what is said of them.
NO_PARTS = [
    ({"null": NAN}, "expected a null of effect 'bias' .*; got nan"),
    ({"null": [0.0, 0.0]}, r"expected a null of effect 'bias' of shape \(1,\)"),
    ({"prior": 1.0}, "expected a continuous torch prior of effect 'bias'"),
    ({"prior": LogNormal(0.0, 200.0)}, "expected finite draws .*; got NaN or inf"),
]


@pytest.mark.parametrize(("changes", "message"), NO_PARTS)
def test_parts_that_are_none_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        effect(**changes)


#: Priors, nulls, and whether one allows the other.
NULLS = [
    (Uniform(1.0, 2.0), 0.0, False),
    (HalfNormal(1.0), -0.5, False),
    (Uniform(torch.zeros(2), torch.ones(2)), torch.tensor([0.0, 1.5]), False),
    (Normal(0.0, 1.0), 0.0, True),
    (Uniform(-1.0, 0.0), 0.0, True),
    (LogNormal(0.0, 1.0), 0.0, True),
    (BoxUniform(torch.zeros(1), torch.ones(1)), 0.0, True),
]


@pytest.mark.parametrize(("prior", "null", "is_taken"), NULLS)
def test_a_prior_allows_its_null_within_or_on_its_edge(prior, null, is_taken):
    def apply(value, phi, action, context):
        return value + (phi - torch.as_tensor(null)).sum(-1, keepdim=True)

    own = effect(prior=prior, null=null, apply=apply)
    if is_taken:
        require_nested([own])
        return
    message = "expected a prior of effect 'bias' that allows its null"
    with pytest.raises(ValueError, match=message):
        loop(own)
    with pytest.raises(ValueError, match=message):
        Campaign(MODEL, PRIOR, ACTIONS, effects=[own])


def test_infinite_nulls_and_nuisances_need_no_prior_that_allows_them():
    require_nested(generic_effects(MODEL, ACTIONS, prior=PRIOR))
    require_nested([effect(prior=Uniform(1.0, 2.0), scope="trial")])


def test_what_is_kept_may_change_afterwards():
    """The null that was given, and a view that apply returned of what it keeps."""
    for null in (torch.zeros(1), np.zeros(1)):
        made = effect(null=null)
        null[0] = 5.0
        assert float(made.null_phi(1)) == 0.0
    kept = torch.zeros(100, 1)

    def apply(x, phi, action, context):
        kept[: len(x)] = x + phi
        return kept[: len(x)]

    model = AugmentedSimulator(MODEL, [effect(apply=apply)])
    theta, action = torch.tensor([[0.5, 1.0]]), torch.ones(1, 1)
    first = model.mean(theta, action)
    model.mean(2 * theta, action)
    assert float(first) == pytest.approx(1.5)


def test_an_effect_named_like_a_parameter_would_share_its_row():
    message = "expected effects named unlike parameters.*got {} more than once"
    with pytest.raises(ValueError, match=message.format("theta_1")):
        loop(effect("theta_1"))
    named = SimulatorModel(MODEL.fn, noise=MODEL.noise, parameter_names=["mass"])
    with pytest.raises(ValueError, match=message.format("mass")):
        AugmentedSimulator(named, [effect("mass")])
    two = effect(
        "drag",
        prior=Normal(torch.zeros(2), torch.ones(2)),
        apply=lambda x, phi, action, context: x + phi.sum(-1, keepdim=True),
    )
    with pytest.raises(ValueError, match=message.format("drag_1")):
        joint_prior(PRIOR, [two, effect("drag_1")])


def no_change(value, phi, action, context):
    return None


def louder(sd, phi, action, context):
    sd *= 1.5 + phi  # in place
    return sd


#: Hooks, what apply returns, priors, and what is said.
RETURNED = [
    ("observation", no_change, NORMAL, r"of shape \(16, 1\); got NoneType"),
    ("observation", lambda v, phi, a, c: v + phi[:, 0], NORMAL, r"got \(16, 16\)"),
    ("action", lambda v, phi, a, c: (v + phi)[:, 0], NORMAL, r"got \(16,\)"),
    ("dynamics", no_change, NORMAL, "a dict of keyword arguments; got NoneType"),
    ("noise", lambda v, phi, a, c: phi, NORMAL, "vanish at its null"),
    ("noise", louder, HalfNormal(1.0), r"the noise changed by up to 0\.5"),
    ("noise", lambda v, phi, a, c: v * (1 + phi), Normal(0.0, 2.0), "positive; got"),
]


@pytest.mark.parametrize(("hook", "apply", "prior", "message"), RETURNED)
def test_apply_that_returns_something_else_is_named(hook, apply, prior, message):
    with pytest.raises(ValueError, match=f"(?s)effect 'bias'.*{message}"):
        loop(effect(hook=hook, apply=apply, prior=prior))


def in_place(value, phi, action, context):
    value += phi
    phi.zero_()
    action.zero_()
    context.index.zero_()
    return value


@pytest.mark.parametrize("hook", ["action", "parameter", "observation", "noise"])
def test_apply_may_change_what_it_gets(hook):
    prior = HalfNormal(1.0)
    second = effect("slope", apply=lambda x, phi, action, context: x + phi * action)
    names = {"bias": 0.3, "slope": 0.2}
    given = [torch.full((4, 1), 0.5), torch.full((4, 1), 2.0), torch.ones(4)]
    phi = {name: torch.full((4, 1), value) for name, value in names.items()}
    x = {}
    for apply in (in_place, lambda v, phi, action, context: v + phi):
        model = AugmentedSimulator(
            MODEL, [effect(hook=hook, prior=prior, apply=apply), second]
        )
        context = Context(given[2])
        x[apply] = model.evaluate(given[0], phi, given[1], context=context)
        scale = model.noise_scale(phi, given[1], torch.ones(4, 1), context=context)
        assert float(scale[0, 0]) == pytest.approx(1.3 if hook == "noise" else 1.0)
    assert torch.equal(*x.values())
    assert [float(v[0]) for v in given] == pytest.approx([0.5, 2.0, 1.0])
    assert float(phi["bias"][0]) == pytest.approx(0.3)
