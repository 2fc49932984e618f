"""Every method of a campaign, through the same protocol."""

import warnings

import cloudpickle
import pytest
import torch
from attrs import evolve

from sbi_active import MixtureDensity
from sbi_active.campaign.learning.methods import METHODS
from sbi_active.inference import LFIRE
from tests.campaign.problem import OPTIONS, RATIOS, REFINEMENT, campaign, noisy

DENSITY = MixtureDensity(hidden_features=(16,), num_components=2, num_iterations=150)
TRAINED = {**dict.fromkeys(("asbi", "nsbi", "alhi", "nlhi"), DENSITY), "seqbed": RATIOS}
FEW = evolve(RATIOS, num_iterations=5)
QUICK = {**dict.fromkeys(TRAINED, OPTIONS.density_estimator), "seqbed": FEW}
GAINS = {"asbi": "posterior", "alhi": "likelihood", "seqbed": "ratio"}


def measured(action):
    return 0.7 * action


def small(method, **changes):
    sizes = {"num_simulations": 600, "density_estimator": TRAINED[method]}
    return campaign(method, noisy, **{**sizes, **changes})


@pytest.mark.parametrize("method", METHODS)
def test_a_round_its_cost_and_a_copy_that_goes_on(method):
    sizes = {"num_simulations": 300, "density_estimator": QUICK[method]}
    c = small(method, **sizes)
    trial = c.ask()
    assert METHODS[method].designs == (trial.target == "theta")
    assert trial.design.bound in ("lower", "none")
    c.tell(measured(trial.action))
    belief = c.update()
    assert float((belief.sample((2_000,)) - 0.7).abs().median()) < 0.3
    spent = c.history[0].num_simulations - 200 - trial.design.num_simulations
    trained = 300 if "training" in c.history[0].cpu_seconds else 0
    assert spent - trained == belief.diagnostics.num_simulations
    if method in ("asbi", "nsbi"):  # stops by itself
        assert 0 < spent - trained <= 17 * REFINEMENT.num_histories
    else:
        with pytest.raises(ValueError, match="whose network is a posterior; got"):
            c.posterior  # noqa: B018
    if not METHODS[method].designs:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sbi's, of what its trainers lose
        copy = cloudpickle.loads(cloudpickle.dumps(c))
    assert copy.ask().action.equal(c.ask().action)
    for one in (c, copy):
        one.tell(torch.tensor([0.68]), action=[1.0])
        one.update()
    theta = torch.linspace(0.05, 0.95, 7)[:, None]
    expected = c.belief.log_prob(theta).tolist()
    assert copy.belief.log_prob(theta).tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("method", GAINS)
def test_each_method_has_its_authors_utility(method):
    c = small(method, estimator=GAINS[method], refine=False, num_samples=200)
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
    sizes = {"num_simulations": 300, "refine": False, "estimator": "ratio"}
    c = small("seqbed", density_estimator=LFIRE(), **sizes)
    c.run(measured, num_rounds=1)
    assert c.belief.label == "weighted particles"
    assert c.history[0].design.estimator == "RatioGain"
    assert c.history[0].action.tolist() == [3.0]
    assert abs(float(c.belief.mean) - 0.7) < 0.15
