"""Workers and other options, as values."""

import copy
import pickle
from functools import partial
from typing import Any

import pytest
import torch
from attrs import evolve

from sbi_active import CampaignOptions, MixtureDensity, simulate
from sbi_active.campaign.options import CampaignDetails, StopRules
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.inference import LFIRE, RefinementOptions
from sbi_active.inference.networks.mixture_density import MixtureDetails
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.messages import RenamedWarning
from sbi_active.migration.described import options_from
from sbi_active.simulation import Workers

ROWS = torch.ones(1, 1), torch.ones(1, 1)


def fails(theta, action, *, times, attempts):
    attempts.append(len(theta))
    if len(attempts) <= times:
        raise RuntimeError("licence server")
    return theta + action


def test_a_simulation_takes_them_as_one_value_or_their_number():
    simulator = partial(fails, times=2, attempts=[])
    assert simulate(simulator, *ROWS, seed=0, workers=Workers(1, None, 2)).x == 2
    assert simulate(torch.add, *ROWS, seed=0, workers=1).x == 2
    assert CampaignOptions(workers=2).workers == Workers(2)


def test_former_options_of_a_campaign_are_taken_for_one_version():
    former: Any = {"num_workers": 2, "time_limit": 9.0, "num_scored": 200}
    with pytest.warns(RenamedWarning) as noted:
        options = CampaignOptions(**former, num_samples=10)
    assert {note.message.code for note in noted} == {"SA701"}
    assert {note.filename for note in noted} == {__file__}
    assert options.workers == Workers(2, 9.0)
    assert options.details == CampaignDetails(num_scored=200)
    assert CampaignOptions.of({**former, "num_samples": 10}) == options
    assert evolve(options, eliminate=False).details.num_scored == 200
    assert options.num_scored == 200
    with pytest.raises(AttributeError, match="num_rows"):
        _ = options.num_rows
    stored = {"settings": "CampaignOptions", **former, "num_samples": 10}
    assert options_from(stored) == options
    assert decode(encode(options, known={}), known={}) == options
    state = options.__getstate__()
    del state["workers"], state["details"]
    loaded = object.__new__(CampaignOptions)
    loaded.__setstate__({**state, **former})
    assert loaded == options


#: Options, and a name that is mistyped.
VALUES = [
    (Workers(2, 9.0), "num_worker"),
    (StopRules(max_sd=[1, 2]), "max_sds"),
    (CampaignDetails(look_ahead=1), "num_score"),
    (RefinementOptions(num_histories=500), "num_history"),
    (RatioClassifier(hidden_features=(8,)), "hidden_feature"),
    (LFIRE(num_marginal=50), "num_marginals"),
    (CampaignOptions(workers=3), "num_sample"),
    (MixtureDensity.faithful(), "num_iteration"),
    (MixtureDetails(batch_size=7), "batch_sizes"),
]


@pytest.mark.parametrize(("options", "name"), VALUES)
def test_options_are_values(options, name):
    kind = type(options)
    same = [
        *(evolve(options), pickle.loads(pickle.dumps(options))),
        *(copy.copy(options), copy.deepcopy(options)),
        *(decode(encode(options, known={}), known={}), eval_of(options)),
    ]
    for other in same:
        assert other == options
        assert hash(other) == hash(options)
    assert options != kind()
    with pytest.raises(AttributeError):
        setattr(options, next(iter(vars(options))), 3)
    for make in (kind, lambda **given: evolve(options, **given)):
        with pytest.raises(TypeError, match=f"got '{name}'; did you mean"):
            make(**{name: 3})


def eval_of(options):
    """Return what the repr makes."""
    kinds = (Workers, StopRules, CampaignDetails, RefinementOptions, CampaignOptions)
    networks = (RatioClassifier, LFIRE, MixtureDensity, MixtureDetails)
    return eval(repr(options), {kind.__name__: kind for kind in (*kinds, *networks)})


STOPS = {"stop": 3}
BOTH = {"refinement": RefinementOptions(workers=Workers(2))}
#: Settings, what cannot be, and what is said of it.
REFUSED = [
    (Workers, {"num_workers": 0}, "num_workers >= 1, or -1 for one a core; got 0"),
    (Workers, {"num_workers": "two"}, "num_workers >= 1, or -1 for .*; got 'two'"),
    (Workers, {"time_limit": 0.0}, "time_limit > 0 or None; got 0.0; use None"),
    (RefinementOptions, {"defensive": 0.6}, "defensive <= 0.5; got 0.6"),
    (RefinementOptions, {"defensive": 0}, "defensive >= 1e-06; got 0"),
    (RefinementOptions, {"workers": 2}, "workers of class Workers; got 2"),
    (MixtureDensity, {"hidden_features": (8, 0)}, "hidden_features >= 1; got 0"),
    (MixtureDetails, {"learning_rate": 0}, "learning_rate > 0; got 0; use 1e-3"),
    (MixtureDetails, {"activation": "tanh"}, "activation among 'silu', 'relu'"),
    (CampaignOptions, {"estimator": "foo"}, "estimator among 'auto', .*; got 'foo'"),
    (CampaignOptions, {"refine": 3}, "refine of class bool; got 3; pass True or"),
    (CampaignOptions, STOPS, r"stop of class StopRules; got 3; pass StopRules\("),
    (CampaignOptions, {"num_simulations": "many"}, "num_simulations >= 100; got 'many"),
    (CampaignOptions, BOTH, ".*to run as all others"),
    *((StopRules, {"max_sd": v}, "max_sd > 0 or None") for v in (-1.0, [0.1, 0.0])),
    (StopRules, {"min_information_gain": 0.0}, "min_information_gain > 0"),
]


@pytest.mark.parametrize(("kind", "wrong", "expected"), REFUSED)
def test_settings_that_cannot_be_are_refused(kind, wrong, expected):
    with pytest.raises((ValueError, TypeError), match=f"expected {expected}"):
        kind(**wrong)
