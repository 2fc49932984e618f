"""Where fits of sets of effects begin, in libraries of any size."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Uniform

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.linear import screening
from sbi_active.criticism.linear.fits import FitSettings
from sbi_active.criticism.linear.model import centered, linearize
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps import equivalence
from sbi_active.criticism.steps.detection import log_priors
from tests.effects import drift, louder, on_outcomes

SENSOR, NUM_TRIALS, LIMIT, SLOPE = 0.5, 14, 14.0, 2.0


def curve(theta, action):
    a = action[:, :1].to(theta)
    return theta[:, :1] * torch.exp(3 - a) + theta[:, 1:] * a


EFFECTS = [
    on_outcomes(
        "limit",
        lambda x, phi, action, context: x.clamp(-phi.exp(), phi.exp()),
        prior=Independent(Uniform(torch.tensor([0.0]), torch.tensor([4.0])), 1),
        null=torch.inf,
    ),
    drift(),
]


def searched(**settings):
    generator = torch.Generator().manual_seed(0)
    action = 8 * torch.rand(NUM_TRIALS, 1, generator=generator) - 2
    theta = torch.tensor([[-1.9, -4.3]]).expand(NUM_TRIALS, -1)
    drift = SLOPE * torch.arange(NUM_TRIALS)[:, None]
    x = curve(theta, action).clamp(-LIMIT, LIMIT) + drift
    x = x + SENSOR * torch.randn(x.shape, generator=generator)
    model = SimulatorModel(curve, noise=SENSOR)
    prior = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
    loop = Criticism(model, prior, Trials(action, x), effects=EFFECTS, seed=0)
    search = Search(loop.rivals, FitSettings(**settings))
    search.fit_singles()
    return search


def test_parameters_beside_an_effect_without_a_null_are_looked_for_anew():
    """Without the limit the exponential has to vanish, with it it is all there is."""
    search = searched()
    alone = search.found[ModelKey(("drift",))].model.rms
    both = search.fit_set(ModelKey(("limit", "drift"))).model.rms
    assert alone > 5
    assert both < 1 + 3 / np.sqrt(2 * NUM_TRIALS)


def test_no_pair_is_fitted_where_linear_evidence_puts_all_behind():
    search = searched(behind=-np.inf)
    search.fit_larger()
    assert max(len(key.effects) for key in search.found) == 1


def test_slopes_are_from_both_sides_and_at_a_bound_from_within():
    def saturating(theta, xi):
        return torch.tanh(0.1 * xi * theta[:, :1] * theta[:, 1:])

    model = SimulatorModel(saturating, noise=1e-6)
    prior = BoxUniform(torch.tensor([1.0, 0.5]), torch.tensor([20.0, 2.0]))
    xi, unit = torch.linspace(0.5, 1.5, 8)[:, None], np.full(8, 1e-6)
    trials = Trials(xi, torch.tanh(0.99 * xi))
    own = RivalSet(model, prior, trials, []).rival(ModelKey())
    one_sided = linearize(own, own.coordinates.from_z(np.array([[9.0, 1.1]]))[0], unit)
    models = one_sided, centered(own, one_sided, unit)
    # What the trials tell of the direction that they tell least of, which is nothing.
    told = [np.linalg.svd(m.jacobian, compute_uv=False)[-1] for m in models]
    assert told[1] < 0.1 < 1 < told[0]
    for corner in (own.coordinates.low, own.coordinates.high):
        one_sided = linearize(own, corner, unit)
        both = centered(own, one_sided, unit)
        np.testing.assert_allclose(both.jacobian, one_sided.jacobian)
        assert np.isfinite(both.jacobian).all()


# A library of effects, all fitted, and one of one more, screened, say the same


MANY = 10


@pytest.fixture
def many(monkeypatch):
    """Libraries of fewer effects are large."""
    for module in (screening, equivalence):
        monkeypatch.setattr(module, "MANY", MANY)
    monkeypatch.setattr(screening, "FITTED", MANY)


TIMES = torch.linspace(0, 2, 30)
PRIOR = BoxUniform(torch.tensor([-2.0]), torch.tensor([2.0]))


def series(theta, action):
    return theta * action * TIMES


def pattern(k):
    wave = (torch.cos, torch.sin)[k % 2](3 * (1 + k // 2) * TIMES)
    apply = lambda x, phi, action, context: x + phi * wave  # noqa: E731
    return on_outcomes(f"wave {k}", apply, 0.3, family="wave")


def loop_of(number, strength, *more):
    rng = np.random.default_rng(7)
    model = SimulatorModel(series, noise=0.05)
    action = torch.tensor([[0.5], [1.0], [1.5]])
    x = series(torch.tensor([[0.7]]), action) + strength * torch.cos(6 * TIMES)
    x = x + 0.05 * torch.from_numpy(rng.standard_normal(x.shape)).float()
    effects = [*map(pattern, range(number)), *more]
    return Criticism(model, PRIOR, Trials(action, x), effects=effects, seed=0)


def test_clean_trials_of_many_effects_say_none(many):
    assert loop_of(MANY + 1, 0.0).trace().verdict == "none"


def test_one_effect_more_does_not_change_the_verdict(many):
    few, more = (loop_of(MANY + k, 0.2).trace() for k in (0, 1))
    assert few.verdict == more.verdict == "wave 2"
    assert abs(few.inclusion["wave 2"] - more.inclusion["wave 2"]) < 0.1


def test_what_was_set_aside_counts_in_the_prior_and_is_said(many):
    loop = loop_of(MANY + 6, 0.2, louder())
    report = loop.report(evaluate=False, plan=False)
    assert len(loop.rivals.effects) < len(loop.effects)
    assert "SA527" in [w.code for w in report.warnings]
    assert log_priors(loop.rivals.library) == log_priors(loop.effects)
    gone = next(iter(loop.screening.behind))
    assert loop.add([gone])[1].event_shape[0] == 2  # can be added all the same
    assert "louder" in loop.screening.kept  # of which no column tells
