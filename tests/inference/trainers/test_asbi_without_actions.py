"""Without ``action=``, ASBI is NPE_C: to the last bit, and right."""

import pytest
import torch
from sbi.inference import NPE_C, DirectPosterior
from sbi.simulators.linear_gaussian import linear_gaussian
from torch.distributions import MultivariateNormal

from sbi_active import ASBI
from sbi_active.inference.trainers.action_rounds import SilentTracker

DIM = 2
SHIFT, COV = -torch.ones(DIM), 0.3 * torch.eye(DIM)
PRIOR = MultivariateNormal(torch.zeros(DIM), torch.eye(DIM))
X_O = torch.zeros(1, DIM)


def simulate(theta):
    return linear_gaussian(theta, SHIFT, COV)


def two_rounds(trainer_class, density_estimator, **train):
    torch.manual_seed(1)
    trainer = trainer_class(
        PRIOR, density_estimator, tracker=SilentTracker(), show_progress_bars=False
    )
    proposal = PRIOR
    for _ in range(2):
        theta = proposal.sample((100,))
        x = simulate(theta)
        trainer.append_simulations(theta, x, proposal=proposal)
        trainer.train(max_num_epochs=2, training_batch_size=50, **train)
        posterior = trainer.build_posterior().set_default_x(X_O)
        proposal = posterior
    return posterior, trainer


@pytest.mark.filterwarnings("ignore:.*Maximum number of epochs")
@pytest.mark.parametrize("density_estimator", ["mdn", "maf"])
def test_two_rounds_are_numerically_npe_c(density_estimator):
    ours, our_trainer = two_rounds(ASBI, density_estimator)
    theirs, their_trainer = two_rounds(NPE_C, density_estimator)
    assert type(ours) is DirectPosterior
    for name, value in their_trainer._neural_net.state_dict().items():
        assert torch.equal(our_trainer._neural_net.state_dict()[name], value)
    summary = their_trainer.summary
    assert our_trainer.summary["validation_loss"] == summary["validation_loss"]
    theta = PRIOR.sample((10,))
    torch.manual_seed(2)
    expected = theirs.log_prob(theta), theirs.sample((5,))
    torch.manual_seed(2)
    assert torch.equal(ours.log_prob(theta), expected[0])
    assert torch.equal(ours.sample((5,)), expected[1])
