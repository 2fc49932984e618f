"""Bad input gets a clear error that says what to do."""

import re

import pytest
import torch
from sbi.utils import BoxUniform

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


def test_rounds_with_and_without_action_do_not_mix():
    theta, x, action = rows()
    with raises("expected action=, since belief= was given"):
        ASBI(PRIOR).append_simulations(theta, x, belief=PRIOR)
    inference = ASBI(PRIOR, "mdn").append_simulations(theta, x)
    with raises("start a new ASBI(prior) for rounds with actions"):
        inference.append_simulations(theta, x, action=action)


def test_what_a_trained_round_refuses():
    inference = with_round()
    with raises("expected a network trained under the current belief", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))
    with raises("expected a network trained under the current belief", RuntimeError):
        inference.build_posterior()
    with raises("expected resume_training after train() on the same rows"):
        inference.train(resume_training=True)
    inference.train()
    with raises("expected action of shape (1, 1) or (1,); got (3,)"):
        inference.update(torch.zeros(2), action=torch.zeros(3))
    with raises("expected one outcome; got 2 rows"):
        inference.update(torch.zeros(2, 2), action=torch.zeros(1))
    posterior = inference.build_posterior()
    with raises("expected x= and action= together; got x without action"):
        posterior.sample((3,), x=torch.zeros(2))
    with raises("expected x= and action= together; got neither"):
        posterior.map()
    inference.update(torch.zeros(2), action=torch.zeros(1))
    with raises("append simulations of the belief with action=", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))
