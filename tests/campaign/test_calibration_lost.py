import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    RefinementOptions,
    SimulatorModel,
    StopRules,
)
from sbi_active.campaign.checks import calibration

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=GaussianNoise(0.1))
NETWORK = MixtureDensity(hidden_features=(8,), num_iterations=30)


def campaign(**options):
    settings = CampaignOptions(
        num_simulations=300,
        num_samples=40,
        density_estimator=NETWORK,
        refinement=RefinementOptions(num_histories=400),
        stop=StopRules(calibration_lost=True),
        **options,
    )
    return Campaign(
        MODEL, PRIOR, DiscreteActions([1.0, 2.0]), method="nsbi", options=settings
    )


def test_a_right_belief_goes_on_and_is_judged_once(monkeypatch):
    c, calls = campaign(network="on demand"), []
    check = calibration.check_belief

    def counted(*arguments, **options):
        calls.append(1)
        return check(*arguments, **options)

    monkeypatch.setattr(calibration, "check_belief", counted)
    c.run(lambda action: 0.4 * action, num_rounds=2)
    assert len(c.history) == 2
    assert c.stop_reason is None
    assert len(calls) == 2


@pytest.mark.parametrize("refine", [True, False])
def test_a_lost_calibration_stops(refine, monkeypatch):
    class Found:
        verdict, reasons = "stop", ("it excludes the truth",)

    name = "check_belief" if refine else "check_calibration"
    monkeypatch.setattr(calibration, name, lambda *_, **__: Found)
    c = campaign(refine=refine)
    c.run(lambda action: 0.4 * action, num_rounds=3)
    assert len(c.history) == 1
    assert c.stop_reason == "calibration is lost: it excludes the truth"
