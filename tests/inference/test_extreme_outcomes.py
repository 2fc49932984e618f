"""Outcomes as far away as float32 reaches, told to the trainers themselves."""

import pytest
import torch

from sbi_active import (
    ALHI,
    ASBI,
    RefinementOptions,
    SeqBED,
)
from sbi_active.inference import SeqBED_LFIRE
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from tests.campaign.problem import MODEL, OPTIONS, PRIOR, RATIOS

SETTINGS = RefinementOptions(num_histories=300, num_effective=25)
SIZES = (1e15, -3e38)


def trained(make):
    torch.manual_seed(0)
    theta, action = PRIOR.sample((300,)), torch.ones(300, 1)
    if make is SeqBED_LFIRE:
        trainer = SeqBED_LFIRE(PRIOR)
        theta, action = trainer.arrange(theta, action)
    else:
        network = RATIOS if make is SeqBED else OPTIONS.density_estimator
        trainer = make(PRIOR, network, show_progress_bars=False)
    x = theta * action + 0.1 * torch.randn_like(theta)
    trainer.append_simulations(theta, x, action=action).train()
    return trainer


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("make", "simulator", "x"),
    [
        *[(make, None, -3e38) for make in (ASBI, ALHI, SeqBED, SeqBED_LFIRE)],
        *[(ASBI, MODEL, x) for x in SIZES],
    ],
)
def test_updates_give_a_belief_to_go_on_from(make, simulator, x):
    trainer = trained(make)
    told = {"simulator": simulator, "refinement": SETTINGS, "seed": 1}
    try:
        belief = trainer.update(torch.tensor([x]), action=torch.ones(1), **told)
    except UnexplainedOutcomeError:  # no parameters have a likelihood at all
        assert trainer.trials == []
    else:
        assert bool(belief.sample((50,)).isfinite().all())
        assert not bool(belief.log_prob(PRIOR.sample((50,))).isnan().any())
    if simulator is not None:
        after = trainer.update(torch.tensor([0.6]), action=torch.ones(1), **told)
        assert bool(after.sample((50,)).isfinite().all())


@pytest.mark.parametrize("x", SIZES)
def test_what_the_network_cannot_say_changes_nothing(x):
    trainer = trained(ASBI)
    if x == 1e15:  # squares still fit: coarse, and said to be
        with pytest.warns(UserWarning, match="lies within the prior's support"):
            trainer.update(torch.tensor([x]), action=torch.ones(1))
        return
    with pytest.warns(UserWarning, match="its density is finite nowhere"):
        belief = trainer.update(torch.tensor([x]), action=torch.ones(1))
    assert belief.diagnostics.trustworthy is False
    theta = torch.tensor([[0.2], [0.7]])
    assert torch.equal(belief.log_prob(theta), PRIOR.log_prob(theta))
