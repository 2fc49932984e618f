import pytest
import torch

from sbi_active.inference import MixtureDensity
from sbi_active.inference.networks.mixture_density import (
    TrainingBudget,
    train_mixture_density,
)


def network(dim=3, condition_dim=4, n=200, **settings):
    theta = torch.randn(n, dim) * torch.tensor([0.01, 1.0, 100.0])[:dim] + 5
    net = MixtureDensity(hidden_features=(16,), **settings)(
        theta, torch.randn(n, condition_dim)
    )
    for p in net.parameters():  # far from the start, so that nothing is trivial
        torch.nn.init.normal_(p, 0.0, 0.3)
    return net, theta


def test_densities_of_many_dimensions_are_those_of_few(monkeypatch):
    """Above a dimension they go through matrices, and nothing else changes."""
    theta = torch.randn(100, 14)
    net = MixtureDensity(hidden_features=(16,))(theta, torch.randn(100, 4))
    condition, x = torch.randn(5, 4), theta[:7, None].expand(-1, 5, -1)
    found = net.log_prob(x, condition)
    monkeypatch.setattr(
        "sbi_active.inference.networks.mixture_network.FEW_DIMENSIONS", 14
    )
    assert torch.allclose(net.log_prob(x, condition), found, rtol=1e-4, atol=1e-4)
    assert found.shape == (7, 5)
    assert found.std() > 0.1


def test_shapes_follow_sbi():
    net, theta = network()
    condition = torch.randn(7, 4)
    assert net.sample(torch.Size([5, 2]), condition).shape == (5, 2, 7, 3)
    assert net.log_prob(theta[:7], condition).shape == (1, 7)
    assert net.log_prob(theta[:14].reshape(2, 7, 3), condition).shape == (2, 7)
    assert net.loss(theta[:7], condition).shape == (7,)
    pairs = torch.randn(2, 7, 4)
    both = net.log_prob(theta[:14].reshape(2, 7, 3), pairs)
    assert torch.allclose(both[1], net.log_prob(theta[7:14], pairs[1])[0], atol=1e-5)
    with pytest.raises(ValueError, match="condition"):
        net.log_prob(theta[:7], torch.randn(7, 5))


def test_missing_outcomes_are_something_to_condition_on():
    """x is missing exactly where theta > 0: the mask alone must tell that."""
    theta = torch.randn(2_000, 1)
    x = torch.where(theta > 0, torch.nan, torch.randn(2_000, 1))
    condition = torch.cat([x, x, torch.rand(2_000, 1)], 1)
    net = MixtureDensity(hidden_features=(32,))(theta, condition)
    assert net.knows(torch.tensor([[torch.nan, torch.nan, 0.0]]))
    assert not net.knows(torch.tensor([[0.0, 0.0, torch.nan]]))
    # The columns go missing together: the layers see three numbers and one mask.
    assert next(net.net.parameters()).shape[1] == 3 + 1
    train_mixture_density(
        net,
        torch.optim.Adam(net.parameters(), lr=5e-3),
        theta,
        condition,
        train_rows=torch.arange(2_000),
        held_out_rows=torch.arange(0),
        budget=TrainingBudget(num_iterations=300, batch_size=100),
    )
    # Half of the draws if it could not tell; Gaussians leak some over the hard edge.
    draws = net.sample(torch.Size([1_000]), torch.tensor([[torch.nan, torch.nan, 0.5]]))
    assert (draws > 0).float().mean() > 0.85
    draws = net.sample(torch.Size([1_000]), torch.tensor([[0.3, 0.3, 0.5]]))
    assert (draws < 0).float().mean() > 0.85


def test_faithful_settings_condition_on_nothing_but_z_scores():
    """The paper's setting: the same network whether or not the action is known."""
    theta, condition = torch.randn(200, 2), torch.randn(200, 3)
    nets = []
    for call in ("__call__", "build"):
        torch.manual_seed(0)
        arguments = () if call == "__call__" else (1,)
        settings = MixtureDensity.faithful()
        net = getattr(settings, call)(theta, condition, *arguments)
        train_mixture_density(
            net,
            torch.optim.Adam(net.parameters(), lr=1e-3),
            theta,
            condition,
            train_rows=torch.arange(180),
            held_out_rows=torch.arange(180, 200),
            budget=TrainingBudget(num_iterations=20, batch_size=50),
        )
        assert net.conditioning is None
        assert net.baseline_kind == "none"
        nets.append(net)
    mean, scale = condition.mean(0), condition.std(0, correction=0)
    assert torch.allclose(nets[1].condition_mean, mean, atol=1e-6)
    assert torch.allclose(nets[1].condition_scale, scale, atol=1e-6)
    assert torch.allclose(nets[1].theta_mean, theta.mean(0), atol=1e-6)
    states = [net.state_dict() for net in nets]
    assert list(states[1]) == [
        *("condition_mean", "condition_scale", "theta_mean", "theta_scale"),
        "strict_upper",
        *(f"net.{layer}.{kind}" for layer in (0, 2, 4) for kind in ("weight", "bias")),
    ]
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name])


def test_patience_returns_the_best_weights():
    theta, condition = torch.randn(60, 1), torch.randn(60, 2)  # nothing to learn
    net = MixtureDensity(hidden_features=(64,))(theta, condition)
    record = train_mixture_density(
        net,
        torch.optim.Adam(net.parameters(), lr=1e-2),
        theta,
        condition,
        train_rows=torch.arange(40),
        held_out_rows=torch.arange(40, 60),
        budget=TrainingBudget(num_iterations=2_000, batch_size=20, patience=5),
    )
    assert len(record.seconds) < 1_000
    held_out = float(net.loss(theta[40:], condition[40:]).mean())
    assert held_out == pytest.approx(min(record.validation_loss), abs=1e-5)


def test_a_loss_that_is_not_finite_is_told():
    theta, condition = torch.randn(60, 1), torch.randn(60, 2)
    net = MixtureDensity(hidden_features=(8,))(theta, condition)
    with pytest.raises(RuntimeError, match="expected a finite loss"):
        train_mixture_density(
            net,
            torch.optim.Adam(net.parameters(), lr=1e-3),
            theta * torch.nan,
            condition,
            train_rows=torch.arange(40),
            held_out_rows=torch.arange(40, 60),
            budget=TrainingBudget(num_iterations=10, batch_size=20),
        )
