"""The campaign that starts on the wrong simulator, in small."""

import torch

from benchmarks.criticism.campaign import (
    non_centrality,
)


def test_two_settings_hide_what_a_third_and_the_prior_show():
    theta = torch.tensor([[1.0, -1.0]])
    two = torch.tensor([[-5.0], [5.0], [5.0], [-5.0]]).double()
    assert non_centrality(two, theta, 0.5) < 1e-6
    three = torch.cat([two, torch.tensor([[-2.5]]).double()])
    assert non_centrality(three, theta, 0.5) > 25
    # theta_2 would have to leave its box.
    assert non_centrality(two, torch.tensor([[1.0, 4.0]]), 2.0) > 25
