import torch

from sbi_active.design.cells import cells
from sbi_active.search.gradient import regression


def smooth(point):
    wave = torch.sin(5 * point[:, 0]) + 0.5 * point[:, 1]
    return wave + torch.where(point[:, 2] == 1, 1.0, 0.0)


def moments(process, point):
    """Mean and standard deviation, both (m,)."""
    mean, variance = process(point)
    return mean[:, 0], variance[:, 0].sqrt()


def data(num, error):
    generator = torch.Generator().manual_seed(0)
    point = torch.rand(num, 3, generator=generator, dtype=torch.float64)
    point[:, 2] = (point[:, 2] > 0.5).double()
    noise = error * torch.randn(num, generator=generator, dtype=torch.float64)
    return point, smooth(point) + noise


def test_it_follows_a_smooth_function_within_its_errors():
    point, value = data(80, 0.1)
    surrogate = regression(point, value, torch.full((80,), 0.1), num_continuous=2)
    new, _ = data(400, 0.0)
    with torch.no_grad():
        mean, sd = moments(surrogate, new)
    z = (mean - smooth(new)) / sd
    assert float(z.square().mean()) < 3
    assert float((mean - smooth(new)).square().mean().sqrt()) < 0.1
    # what the values' errors hide is not known
    with torch.no_grad():
        wide = regression(point, value, torch.ones(80), num_continuous=2)
        _, vague = moments(wide, new)
    assert (vague > sd).double().mean() > 0.9


def test_it_has_a_gradient_where_the_function_has():
    point, value = data(120, 1e-3)
    surrogate = regression(point, value, torch.full((120,), 1e-3), num_continuous=2)
    z = torch.tensor([[0.5, 0.5, 0.0], [0.2, 0.7, 1.0]], dtype=torch.float64)
    z.requires_grad_(True)
    surrogate(z)[0].sum().backward()
    assert z.grad is not None
    exact = torch.stack([5 * torch.cos(5 * z[:, 0]), torch.full((2,), 0.5)], 1)
    assert ((z.grad[:, :2] - exact).abs() < 0.3).all()
    h = 1e-5
    step = torch.tensor([h, 0.0, 0.0], dtype=torch.float64)
    with torch.no_grad():
        high, low = surrogate(z + step)[0], surrogate(z - step)[0]
        finite = (high - low)[:, 0] / (2 * h)
    assert torch.allclose(z.grad[:, 0], finite, atol=1e-4)


def test_influence_is_the_error_of_the_mean():
    """Over many data sets the mean varies as one data set says it does."""
    means, said = [], []
    z = torch.tensor([[0.4, 0.5, 1.0]], dtype=torch.float64)
    for seed in range(60):
        generator = torch.Generator().manual_seed(seed)
        point = torch.rand(60, 3, generator=generator, dtype=torch.float64)
        point[:, 2] = 1.0
        noise = 0.3 * torch.randn(60, generator=generator, dtype=torch.float64)
        value = smooth(point) + noise
        surrogate = regression(point, value, torch.full((60,), 0.3), num_continuous=2)
        with torch.no_grad():
            means.append(float(surrogate(z)[0]))
            influence = surrogate.influence(z)
        said.append(float(influence.square().sum()) ** 0.5)
    spread = torch.tensor(means).std()
    ratio = float(torch.tensor(said).mean() / spread)
    assert 0.6 < ratio < 1.4  # 4 standard errors of a standard deviation of 60, .36


def test_cells_hold_neighbors_of_one_category():
    generator = torch.Generator().manual_seed(0)
    point = torch.rand(1_000, 3, generator=generator, dtype=torch.float64)
    point[:, 2] = (point[:, 2] * 3).floor()
    groups = cells(point, 50, num_continuous=2)
    assert torch.cat(groups).sort().values.tolist() == [*range(1_000)]
    assert 40 <= len(groups) <= 100
    for group in groups:
        inside = point[group]
        assert len(inside[:, 2].unique()) == 1
        width = inside[:, :2].amax(0) - inside[:, :2].amin(0)
        assert float(width.max()) < 0.6
