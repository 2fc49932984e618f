import torch

from sbi_active.inference import MixtureDensity
from sbi_active.inference.networks.mixture_density import (
    train_mixture_density,
)
from sbi_active.inference.sampling.adam import Adam


def network(dim=3, condition_dim=4, n=200, **settings):
    theta = torch.randn(n, dim) * torch.tensor([0.01, 1.0, 100.0])[:dim] + 5
    net = MixtureDensity(hidden_features=(16,), **settings)(
        theta, torch.randn(n, condition_dim)
    )
    for p in net.parameters():  # far from the start, so that nothing is trivial
        torch.nn.init.normal_(p, 0.0, 0.3)
    return net, theta


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
            Adam(net.parameters(), rate=1e-3),
            theta,
            condition,
            train_rows=torch.arange(180),
            held_out_rows=torch.arange(180, 200),
            num_iterations=20,
            batch_size=50,
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


def test_beyond_twelve_parameters_draws_follow_the_density():
    """Factors of a component are its own there, and one solve serves its draws."""
    torch.manual_seed(0)
    dim, condition = 13, torch.randn(300, 4)
    net = MixtureDensity(hidden_features=(8,), num_components=2).build(
        torch.randn(300, dim), condition, 1
    )
    *_, last = net.net.children()
    assert last.out_features == 2 * (1 + 2 * dim)
    own = dict(net.named_parameters())
    for name in ("_upper", "net.2.bias"):
        torch.nn.init.normal_(own[name], 0.0, 0.3)
    row = condition[:1]
    with torch.no_grad():
        drawn = net.sample(torch.Size([20_000]), row)[:, 0]
        log_q = net.log_prob(drawn[:, None], row)[:, 0].double()
    # Under q the mean of f / q is the integral of any density f.
    normal = torch.distributions.MultivariateNormal(drawn.mean(0), drawn.T.cov() / 2)
    ratio = (normal.log_prob(drawn).double() - log_q).exp()
    assert abs(float(ratio.mean()) - 1) < 5 * float(ratio.std()) / 20_000**0.5 < 0.2
