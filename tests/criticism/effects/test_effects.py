import math

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import (
    AugmentedSimulator,
    Context,
    Effect,
    generic_effects,
    joint_prior,
)
from sbi_active.simulation import simulate
from tests.effects import drift, effect

PRIOR = BoxUniform(-torch.ones(2), torch.ones(2))
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 9))


def line(theta, action, curvature=0.0):
    xi = action[:, 0]
    return (theta[:, 0] + theta[:, 1] * xi + curvature * xi**2)[:, None]


MODEL = SimulatorModel(line, noise=0.1, parameter_names=["a", "b"])


HOOKS = {
    "action": effect("offset", hook="action", apply=lambda v, phi, a, c: v + phi),
    "parameter": effect("aging", hook="parameter", apply=lambda v, phi, a, c: v + phi),
    "dynamics": effect(
        "curvature",
        hook="dynamics",
        apply=lambda v, phi, a, c: {**v, "curvature": phi[:, 0]},
    ),
    "observation": effect(),
    "noise": effect(
        "inflation",
        hook="noise",
        prior=HalfNormal(1.0),
        apply=lambda sd, phi, a, c: sd * (1 + phi),
    ),
}
#: The noise-free x of a = 0.5, b = -0.25 at the action 2 under phi = 0.4.
EXPECTED = {
    "action": 0.5 - 0.25 * 2.4,
    "parameter": 0.9 + 0.15 * 2,
    "dynamics": 0.5 - 0.25 * 2 + 0.4 * 4,
    "observation": 0.5 - 0.25 * 2 + 0.4,
    "noise": 0.5 - 0.25 * 2,
}


@pytest.mark.parametrize("hook", HOOKS)
def test_every_hook_changes_what_it_says_and_nothing_at_its_null(hook):
    model = AugmentedSimulator(MODEL, [HOOKS[hook]])
    x = model.mean(torch.tensor([[0.5, -0.25, 0.4]]), torch.tensor([[2.0]]))
    assert x.item() == pytest.approx(EXPECTED[hook], abs=1e-6)
    assert model.parameter_names == ["a", "b", HOOKS[hook].name]
    theta, action = PRIOR.sample((50,)), ACTIONS.sample((50,), seed=0)
    seeds = torch.arange(50)
    bare = MODEL(theta, action, seeds=seeds)
    both = torch.cat([theta, torch.zeros(50, 1)], -1)
    torch.testing.assert_close(model(both, action, seeds=seeds), bare)


def test_noise_effects_stretch_the_noise():
    model = AugmentedSimulator(MODEL, [HOOKS["noise"]])
    theta = torch.tensor([0.0, 0.0, 2.0]).repeat(4_000, 1)
    x = model(theta, torch.zeros(4_000, 1), seeds=torch.arange(4_000))
    # Standard error of a standard deviation of 0.3 from 4,000 draws: 0.3 / sqrt(8000).
    assert float(x.std()) == pytest.approx(0.3, abs=4 * 0.3 / math.sqrt(8_000))


#: Effects, and by how much they change what they should not.
NOT_NESTED = [
    (effect(null=0.5), "0.5"),
    (effect(apply=lambda x, phi, a, c: x + phi + 0.25), "0.25"),
]


@pytest.mark.parametrize(("wrong", "size"), NOT_NESTED)
def test_an_effect_that_does_not_vanish_is_named_with_its_size(wrong, size):
    check = PRIOR.sample((16,)), ACTIONS.sample((16,), seed=0)
    with pytest.raises(ValueError, match=f"effect 'bias' to vanish.*up to {size}"):
        AugmentedSimulator(MODEL, [wrong], check=check)
    later = AugmentedSimulator(MODEL, [wrong])  # the first call compares
    with pytest.raises(ValueError, match="vanish at its null"):
        later.mean(torch.zeros(3, 3), torch.ones(3, 1))


def test_a_null_at_infinity():
    saturation = effect(
        "saturation",
        null=torch.inf,
        prior=Independent(HalfNormal(torch.ones(1)), 1),
        apply=lambda x, phi, a, c: phi * torch.tanh(x / phi),
    )
    check = PRIOR.sample((16,)), ACTIONS.sample((16,), seed=0)
    AugmentedSimulator(MODEL, [saturation], check=check)  # inf * tanh(0) is NaN


def test_the_index_of_a_plain_call_is_the_next_trial():
    model = AugmentedSimulator(MODEL, [drift()], next_index=8)
    x = model.mean(torch.tensor([[0.0, 0.0, 0.5]]), torch.zeros(1, 1))
    assert x.item() == pytest.approx(4.0)
    given = torch.zeros(3, 2), {"drift": torch.ones(3, 1)}, torch.zeros(3, 1)
    rows = model.evaluate(*given, context=Context(torch.tensor([0.0, 1.0, 5.0])))
    assert rows[:, 0].tolist() == [0.0, 1.0, 5.0]


def test_the_joint_prior_is_the_product():
    joint = joint_prior(PRIOR, [HOOKS["observation"], HOOKS["noise"]])
    z = joint.sample((200,))
    expected = PRIOR.log_prob(z[:, :2]) + Normal(0.0, 1.0).log_prob(z[:, 2])
    expected = expected + HalfNormal(1.0).log_prob(z[:, 3])
    torch.testing.assert_close(joint.log_prob(z), expected)
    outside = torch.tensor([[0.0, 2.0, 0.0, 1.0], [0.0, 0.0, 0.0, -1.0]])
    assert joint.log_prob(outside).tolist() == [-math.inf, -math.inf]
    assert joint.support.check(outside).tolist() == [False, False]
    assert joint.mean.shape == joint.stddev.shape == joint.event_shape == (4,)


def test_effects_of_a_trial_are_drawn_in_every_call_and_add_no_parameter():
    release = effect("release", scope="trial", prior=Normal(0.0, 0.5))
    model = AugmentedSimulator(MODEL, [release])
    prior = joint_prior(PRIOR, [release])
    theta = torch.zeros(2_000, 2)
    x = simulate(model, theta, torch.zeros(2_000, 1), seed=0).x
    assert prior.event_shape == (2,)
    expected = math.hypot(0.5, 0.1)
    assert float(x.std()) == pytest.approx(expected, abs=4 * expected / math.sqrt(4e3))


def test_generic_effects_vanish_and_are_scaled_by_noise_and_actions():
    effects = generic_effects(MODEL, ACTIONS, prior=PRIOR)
    check = PRIOR.sample((16,)), ACTIONS.sample((16,), seed=0)
    AugmentedSimulator(MODEL, effects, check=check)
    by_name = {e.name: e for e in effects}
    assert {e.family for e in effects} == {"action", "observation"}
    for name, sd in (("bias", 0.5), ("action offset", 0.2)):
        draws = by_name[name].sample(4_000)
        assert float(draws.std()) == pytest.approx(sd, abs=4 * sd / math.sqrt(8_000))
    one_way = generic_effects(MODEL, DiscreteActions([1.0, 2.0]))
    assert "dead zone" in {*by_name} - {e.name for e in one_way}


def test_an_effect_through_keywords_of_the_simulator():
    def fn(theta, action, *, air_drag=0.0, exponent=1.0):
        return theta * action - torch.as_tensor(air_drag)[..., None] * action**2

    drag = Effect.keyword("air drag", prior=Normal(0.0, 1.0), units="1/m")
    two = {"prior": Normal(torch.zeros(2), torch.ones(2))}
    null = torch.tensor([0.0, 1.0])
    law = Effect.keyword("power law", "air_drag", "exponent", null=null, **two)
    phi, action = torch.tensor([[0.5, 2.0]]), torch.ones(1, 1)
    changed = law.apply({"tilt": 1.0}, phi, action, Context(torch.zeros(1)))
    expected = {"tilt": 1.0, "air_drag": 0.5, "exponent": 2.0}
    assert {k: float(v) for k, v in changed.items()} == expected
    model = AugmentedSimulator(SimulatorModel(fn), [drag])
    x = model(torch.tensor([[3.0, 0.5]]), 2 * action)
    assert float(x) == pytest.approx(3 * 2 - 0.5 * 4)
    with pytest.raises(ValueError, match="expected 2 keywords .* got air_drag"):
        Effect.keyword("law", "air_drag", **two)


def test_a_density_leaves_the_global_generator_alone():
    torch.manual_seed(5)
    state = torch.get_rng_state()
    density = effect(prior=HalfNormal(1.0)).log_prob(torch.tensor([[1.0], [-1.0]]))
    assert density.isfinite().tolist() == [True, False]
    assert torch.equal(state, torch.get_rng_state())
