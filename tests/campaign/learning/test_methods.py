"""Every method of a campaign, through the same protocol."""

import re
import warnings
from dataclasses import replace

import cloudpickle
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    MixtureDensity,
)
from sbi_active.campaign.learning.methods import METHODS, faithful_options
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference import LFIRE, RatioClassifier
from tests.campaign.sizes import REFINEMENT

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([0.1, 1.0, 3.0])
DENSITY = MixtureDensity(hidden_features=(16,), num_components=2, num_iterations=150)
CLASSIFIER = RatioClassifier(hidden_features=(16,), num_iterations=50)
SMALL = CampaignOptions(
    num_simulations=600,
    num_samples=100,
    details=CampaignDetails(num_scored=200),
    refinement=REFINEMENT,
)
TRAINED = {
    **dict.fromkeys(("asbi", "nsbi", "alhi", "nlhi"), DENSITY),
    "seqbed": CLASSIFIER,
}
GAINS = {"asbi": "posterior", "alhi": "likelihood", "seqbed": "ratio"}


def simulator(theta, action):
    return theta * action + 0.1 * torch.randn_like(theta)


def campaign(method, **changes):
    options = replace(SMALL, density_estimator=TRAINED[method])
    return Campaign(
        simulator, PRIOR, ACTIONS, method=method, options=replace(options, **changes)
    )


def measured(action):
    return 0.7 * action


@pytest.mark.parametrize("method", METHODS)
def test_two_rounds_and_what_they_cost(method):
    c = campaign(method)
    belief = c.run(measured, num_rounds=2)
    assert float((belief.sample((2_000,)) - 0.7).abs().median()) < 0.25
    for trial in c.history:
        refined = REFINEMENT.num_histories * (trial.index + 1)
        parts = 600 + 200 + trial.design.num_simulations
        if method in ("asbi", "nsbi"):  # stops by itself
            assert parts < trial.num_simulations <= parts + 17 * refined
        else:
            assert trial.num_simulations == parts + refined
    designed = c.history[0].design.bound
    assert METHODS[method].designs == (c.history[0].target == "theta")
    assert designed in ("lower", "none")


@pytest.mark.parametrize("method", GAINS)
def test_each_method_has_its_authors_utility(method):
    c = campaign(method, estimator=GAINS[method], refine=False, num_samples=200)
    trial = c.ask()
    assert trial.action.tolist() == [3.0]
    assert trial.design.bound == ("lower" if method == "asbi" else "none")
    # log(3 / .1) less the noise's entropy: 1.98; a network on 600 rows is blunt.
    gain = float(trial.design.expected_information_gain[2])
    assert 1.0 < gain < 2.6
    c.tell(measured(trial.action))
    belief = c.update()
    assert belief.diagnostics.num_simulations == 0
    assert abs(float(belief.mean) - 0.7) < 0.1


def test_faithful_seqbed_is_lfire():
    options = replace(
        SMALL, density_estimator=LFIRE(), num_simulations=900, refine=False
    )
    options = replace(options, estimator="ratio")
    c = Campaign(simulator, PRIOR, ACTIONS, method="seqbed", options=options)
    c.run(measured, num_rounds=2)
    assert c.belief.label == "weighted particles"
    assert c.history[0].design.estimator == "RatioGain"
    assert c.history[0].action.tolist() == [3.0]
    assert abs(float(c.belief.mean) - 0.7) < 0.15


@pytest.mark.parametrize(
    "method",
    [
        *["asbi", "alhi", "seqbed"],
        *[pytest.param(name, marks=pytest.mark.slow) for name in ("nsbi", "nlhi")],
    ],
)
def test_a_campaign_resumes_from_its_trials_and_from_a_copy(method):
    whole = campaign(method)
    whole.run(measured, num_rounds=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sbi's, of what its trainers lose
        copy = cloudpickle.loads(cloudpickle.dumps(whole))
    told = campaign(method)
    for trial in whole.history:
        told.tell(trial.x, action=trial.action)
    told.update()
    following = [c.ask() for c in (whole, copy, told)]
    assert len({float(t.action) for t in following}) == 1
    for c in (whole, copy, told):
        c.tell(torch.tensor([0.68]))
        c.update()
    theta = torch.linspace(0.05, 0.95, 7)[:, None]
    expected = whole.belief.log_prob(theta).tolist()
    assert copy.belief.log_prob(theta).tolist() == pytest.approx(expected, abs=1e-4)
    assert told.belief.log_prob(theta).tolist() == pytest.approx(expected, abs=1e-4)


def test_faithful_options():
    assert faithful_options("nsbi") == CampaignOptions.faithful()
    alhi = faithful_options("alhi")
    assert (alhi.estimator, alhi.posterior, alhi.refine) == ("likelihood", "kde", False)
    assert alhi.density_estimator == MixtureDensity.faithful()
    seqbed = faithful_options("seqbed")
    assert isinstance(seqbed.density_estimator, LFIRE)
    total = [o.num_simulations + 21 * o.num_samples for o in (alhi, seqbed)]
    assert total == [52_000, 52_000]


def test_errors():
    valid = "'asbi', 'nsbi', 'alhi', 'nlhi', 'seqbed'; got 'nre'"
    with pytest.raises(ValueError, match=re.escape(valid)):
        Campaign(simulator, PRIOR, ACTIONS, method="nre")
    with pytest.raises(ValueError, match="expected posterior 'importance' for ASBI"):
        campaign("asbi", details=CampaignDetails(posterior="kde"))
