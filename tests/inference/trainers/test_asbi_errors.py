"""Bad input gets a clear error: the texts are part of what users see."""

import re

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution

from sbi_active import ASBI, MixtureDensity

PRIOR = BoxUniform(-torch.ones(2), torch.ones(2))
SETTINGS = MixtureDensity(hidden_features=(8,), num_iterations=10)


def rows(n=50):
    theta = PRIOR.sample((n,))
    return theta, theta + 0.1 * torch.randn(n, 2), torch.rand(n, 1)


def with_round():
    theta, x, action = rows()
    inference = ASBI(PRIOR, SETTINGS, show_progress_bars=False)
    return inference.append_simulations(theta, x, action=action)


def raises(text, error=ValueError):
    return pytest.raises(error, match=re.escape(text))


def test_wrong_action_dimension():
    theta, x, _ = rows()
    inference = with_round()
    with raises("expected action of shape (50, 1) or (1,); got (50, 2)"):
        inference.append_simulations(theta, x, action=torch.rand(50, 2))
    inference.train()
    with raises("expected action of shape (1, 1) or (1,); got (3,)"):
        inference.update(torch.zeros(2), action=torch.zeros(3))


def test_action_missing():
    theta, x, _ = rows()
    with raises("expected action=, since earlier rounds of this trainer have actions"):
        with_round().append_simulations(theta, x)
    with raises("expected action=, since belief= was given"):
        ASBI(PRIOR).append_simulations(theta, x, belief=PRIOR)


def test_rounds_with_and_without_action_do_not_mix():
    theta, x, action = rows()
    inference = ASBI(PRIOR, "mdn").append_simulations(theta, x)
    with raises("start a new ASBI(prior) for rounds with actions"):
        inference.append_simulations(theta, x, action=action)


def test_x_without_action_and_action_without_x():
    inference = with_round()
    inference.train()
    posterior = inference.build_posterior()
    with raises("expected x= and action= together; got x without action"):
        posterior.sample((3,), x=torch.zeros(2))
    with raises("expected x= and action= together; got action without x"):
        posterior.log_prob(torch.zeros(1, 2), action=torch.zeros(1))
    with raises("expected x= and action= together; got neither"):
        posterior.map()


def test_theta_outside_the_prior():
    theta, x, action = rows()
    theta[7] = torch.tensor([0.0, 3.0])
    with raises(
        "expected theta within the prior's support; got 1 of 50 rows outside, the "
        "first [0.0, 3.0] in row 7"
    ):
        ASBI(PRIOR).append_simulations(theta, x, action=action)


def test_all_simulations_invalid():
    theta, x, action = rows()
    with raises("expected at least one simulation with a measurement; got 50 of 50"):
        ASBI(PRIOR).append_simulations(theta, x * torch.nan, action=action)


def test_prior_without_support():
    class NoSupport(Distribution):
        def __init__(self):
            super().__init__(event_shape=torch.Size([2]), validate_args=False)

        def sample(self, sample_shape=()):
            return PRIOR.sample(sample_shape)

        def log_prob(self, value):
            return PRIOR.log_prob(value)

    theta, x, action = rows()
    with raises("expected a prior with a support, which every belief keeps; got NoSup"):
        ASBI(NoSupport()).append_simulations(theta, x, action=action)
    with raises("expected a prior, since a belief starts from it; got None"):
        ASBI().append_simulations(theta, x, action=action)


def test_shapes_of_theta_and_x():
    theta, x, action = rows()
    with raises("expected theta (n, 2) and x (n, ...) with as many rows; got (50, 1)"):
        ASBI(PRIOR).append_simulations(theta[:, :1], x, action=action)
    with raises("expected x of shape (2,) or (n, 2), as simulated; got (50, 3)"):
        with_round().append_simulations(theta, torch.rand(50, 3), action=action)


def test_update_needs_a_network_of_this_round():
    inference = with_round()
    with raises("expected a network trained under the current belief", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))
    inference.train()
    inference.update(torch.zeros(2), action=torch.zeros(1))
    with raises("append simulations of the belief with action=", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))


def test_update_takes_one_outcome():
    inference = with_round()
    inference.train()
    with raises("expected one outcome; got 2 rows"):
        inference.update(torch.zeros(2, 2), action=torch.zeros(1))


def test_posterior_needs_a_network_of_this_round():
    with raises("expected a network trained on this round's", RuntimeError):
        with_round().build_posterior()


@pytest.mark.parametrize(
    "arguments",
    [{"discard_prior_samples": True}, {"use_combined_loss": True}, {"num_atoms": 5}],
)
def test_arguments_without_meaning(arguments):
    name = next(iter(arguments))
    with raises(f"expected {name} to be left out in a round with actions"):
        with_round().train(**arguments)


def test_resume_needs_the_same_rows():
    inference = with_round()
    with raises("expected resume_training after train() on the same rows"):
        inference.train(resume_training=True)


def test_train_without_simulations():
    with raises("No simulations found", RuntimeError):
        ASBI(PRIOR).train()
