import torch

from sbi_active.inference import MixtureDensity


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
