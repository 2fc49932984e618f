"""Beliefs from trajectories against what is known in closed form."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.special import logsumexp
from scipy.stats import gamma, norm
from scipy.stats import t as student_t
from torch.distributions import Gamma, Independent

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials
from sbi_active.criticism.identification import IdentifySettings, identify
from sbi_active.criticism.identification.posterior import ChannelErrors, Posterior
from sbi_active.criticism.linear.mixture import integrated
from sbi_active.criticism.linear.processes import Grams, Processes
from sbi_active.inference.sampling.mixtures import draws_between
from sbi_active.mujoco import randomization
from tests.criticism.linear.test_errors import linear_model
from tests.effects import autocorrelated, on_outcomes

WHITE = Processes(np.ones(1), np.zeros(1), np.full(1, np.inf), np.zeros(1, bool))


def linear(num=200, strength=0.0, low=-np.inf, sd=(1e3, 1e3, 1.0)):
    """Return a line and a doubtful parabola, in errors of size one."""
    rng = np.random.default_rng(0)
    t = np.linspace(-1, 1, num)
    jacobian = np.stack([np.ones(num), t, t**2 - 1 / 3], 1)
    residual = rng.standard_normal(num) - strength * jacobian[:, 2]
    bounds = np.array([low, -np.inf, -np.inf])
    return linear_model(residual, jacobian, sd=np.array(sd), low=bounds)


def white(model, known: np.ndarray | None):
    """Return white errors of a model's only channel."""
    gram = (model.rows.T @ model.rows)[None, None]
    grams = Grams(gram, np.zeros((1, 1)), np.array([model.num]))
    return ChannelErrors(WHITE, grams, known, white=1.0)


def shift(x, phi, action, context):
    """Return the first channel of x with an offset."""
    return x + phi[:, None] * torch.tensor([1.0, 0.0], dtype=x.dtype)


def posterior(model, effect=(-1, -1, -1), *, is_known=True):
    errors, number = white(model, np.ones(1) if is_known else None), np.array(effect)
    rng = np.random.default_rng(1)
    drawn = errors.drawn(errors.places(model, number < 1, 8, rng), 4096, rng)
    effects = [on_outcomes("parabola", shift, 1.0)] * (max(effect) + 1)
    return Posterior(model, effects, number, *drawn, near=3.0)


def draws(model, effect=(-1, -1, -1)):
    return posterior(model, effect).draws(4000, np.random.default_rng(0))


def test_without_doubt_it_is_least_squares():
    model = linear(sd=(1e3, 1e3, 1e3))
    found, jacobian = draws(model), model.jacobian
    cov = np.linalg.inv(jacobian.T @ jacobian)
    best = -cov @ jacobian.T @ model.residual
    assert found.u.mean(0) == pytest.approx(best, abs=0.01)
    assert found.u.std(0) == pytest.approx(np.sqrt(np.diag(cov)), rel=0.05)


def test_presence_has_its_probability():
    """Against the evidence of both models, by the matrix of what is marginal."""
    for strength in (0.0, 0.25):
        model, log_z = linear(strength=strength), []
        r = model.residual
        for k in (2, 3):
            part = model.jacobian[:, :k]
            cov = np.eye(len(r)) + part @ np.diag(model.sd[:k] ** 2) @ part.T
            log_z.append(-0.5 * (r @ np.linalg.solve(cov, r)))
            log_z[-1] -= 0.5 * np.linalg.slogdet(cov)[1]
        expected = 1 / (1 + np.exp(log_z[0] - log_z[1]))
        found = draws(model, (-1, -1, 0))
        assert found.present.mean() == pytest.approx(expected, abs=0.01)
        absent = ~found.present[:, 0]
        assert (found.u[absent, 2] == 0).all()


def test_an_unknown_size_is_summed_out():
    """Ends of an interval are Student's, of 12 numbers."""
    model = linear(num=12, sd=(1e4, 1e4, 1e4))
    found = posterior(model, is_known=False)
    u = found.draws(20_000, np.random.default_rng(0)).u[:, 1]
    freedom = model.num - 3
    cov = np.linalg.inv(model.jacobian.T @ model.jacobian)
    best = -cov @ model.jacobian.T @ model.residual
    square = ((model.residual + model.jacobian @ best) ** 2).sum()
    sd = np.sqrt(cov[1, 1] * square / freedom)
    ends = best[1] + sd * student_t(freedom).ppf([0.025, 0.975])
    assert np.quantile(u, [0.025, 0.975]) == pytest.approx(ends, abs=0.1 * sd)


@pytest.mark.parametrize("is_known", [True, False])
def test_the_sum_over_draws_of_errors_is_that_over_all_of_them(is_known):
    """Of two channels with three hypotheses each, by quadrature over their sizes."""
    model, step = linear(num=40, sd=(3.0, 3.0, 1.0)), 0.02
    apart = np.abs(np.subtract.outer(np.arange(20), np.arange(20)))
    kernels = [np.eye(20), 0.7**apart, 0.3 * np.eye(20) + 0.7 * 0.9**apart]
    rows = model.rows.reshape(2, 20, 4)
    gram = np.stack([[r.T @ np.linalg.solve(k, r) for r in rows] for k in kernels])
    log_det = np.stack([np.repeat(np.linalg.slogdet(k)[1], 2) for k in kernels])
    white, ones = np.array([1.0, 0.0, 0.3]), np.ones(3)
    processes = Processes(np.maximum(white, 0.1), 1 - white, ones, ones > 1)
    known = np.array([0.6, 0.4]) if is_known else None
    errors = ChannelErrors(processes, Grams(gram, log_det, np.full(2, 20)), known)
    rng, every = np.random.default_rng(0), np.ones(3, bool)
    drawn = errors.drawn(errors.places(model, every, 8, rng), 4096, rng)
    found = Posterior(model, [], np.full(3, -1), *drawn, near=3.0)
    # All of them: the variance of each hypothesis, or a fine grid over its logarithm.
    sizes = np.zeros(1) if is_known else np.arange(-2.5, 2.5, step)
    log_z = []
    for h in np.ndindex(3, 3):
        base = np.square(known) / processes.white[[*h]] if is_known else np.ones(2)
        v = base * np.exp(np.stack(np.meshgrid(sizes, sizes), -1).reshape(-1, 2))
        own = (gram[h, [0, 1]] / v[..., None, None]).sum(1)
        prior = np.log(np.where(np.array(h) > 0, 0.25, 0.5)) - 0.5 * log_det[h, [0, 1]]
        told = integrated(own, model, (1.0,))[0][:, 0]
        log_p = (prior - 10 * np.log(v)).sum(1) + told
        log_z.append(logsumexp(log_p) + (0 if is_known else 2 * np.log(step)))
    log_p = found.log_p[0] - np.log(0.5)  # of no effect
    weight = np.exp(log_p - log_p.max())
    error = weight.std() / weight.mean() / 64
    found = logsumexp(log_p) - np.log(4096)
    assert found == pytest.approx(logsumexp(log_z), abs=4 * error)
    assert error < 0.05


def test_bounds_hold():
    model = linear()
    best = -(np.linalg.pinv(model.jacobian) @ model.residual)[0]
    sd = 1 / np.sqrt(model.num)
    low = best + sd  # an edge one deviation above the best
    found = draws(linear(low=low))
    assert found.u[:, 0].min() >= low
    # Of a normal variable above one deviation.
    assert found.u[:, 0].mean() == pytest.approx(best + 1.5251 * sd, abs=0.1 * sd)


def test_draws_between_bounds_that_are_correlated_have_their_moments():
    rng = np.random.default_rng(0)
    cov = np.array([[1.0, 0.8, 0.3], [0.8, 1.0, 0.5], [0.3, 0.5, 1.0]])
    low, high = np.array([0.5, -1.0, -np.inf]), np.array([np.inf, 0.7, np.inf])
    every = rng.multivariate_normal(np.zeros(3), cov, 400_000)
    inside = ((every > low) & (every < high)).all(1)
    shape = 40_000, 3
    given = np.zeros(shape), np.broadcast_to(cov, (*shape, 3))
    u, log_weight = draws_between(*given, low, high, rng)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    assert ((u >= low) & (u <= high)).all()
    assert weight @ u == pytest.approx(every[inside].mean(0), abs=0.02)
    inner = np.cov(every[inside].T)
    assert np.cov(u.T, aweights=weight) == pytest.approx(inner, abs=0.03)
    alone = norm.sf(0.5) * (norm.cdf(0.7) - norm.cdf(-1.0))
    assert np.exp(log_weight).mean() * alone == pytest.approx(inside.mean(), rel=0.03)


# A belief from trajectories of an oscillator, which is solved in closed form


TIMES = torch.arange(120, dtype=torch.float64) / 20
PRIOR = BoxUniform(torch.tensor([1.0, 0.0, 0.5]), torch.tensor([6.0, 1.0, 2.0]))
TRUTH = torch.tensor([3.0, 0.2, 1.2], dtype=torch.float64)
ACTION = torch.tensor([[0.5], [1.0], [1.5], [2.0]], dtype=torch.float64)


def mean(theta, action):
    """Return position, times a gain, and its integral in another unit."""
    frequency, decay, gain = (theta[:, [k]] for k in range(3))
    x = action * torch.exp(-decay * TIMES) * torch.cos(frequency * TIMES)
    return torch.stack([gain * x, 50 * x.cumsum(1) / 20], -1)


def model(noise=None, fn=mean):
    names = ["frequency", "decay", "gain"]
    return SimulatorModel(fn, noise=noise, sample_times=TIMES, parameter_names=names)


def errors(shape, correlation, seed):
    e = np.random.default_rng(seed).standard_normal(shape)
    return torch.from_numpy(autocorrelated(e, correlation)) * torch.tensor([0.02, 1.0])


def recorded(correlation=0.0, seed=0, extra=0.0, theta=TRUTH):
    x = mean(theta.expand(4, -1), ACTION) + extra
    return x + errors(tuple(x.shape), correlation, seed)


@pytest.mark.parametrize("correlation", [0.0, 0.95])
def test_intervals_hold_in_channels_of_different_units(correlation):
    """6 sets: 18 intervals, of which fewer than 14 hold once in 100 times."""
    inside = []
    for seed in range(6):
        x = recorded(correlation, seed)
        found = identify(model(), PRIOR, Trials(ACTION, x), seed=seed).interval()
        ends = zip(found.values(), TRUTH.tolist(), strict=True)
        inside += [low <= t <= high for (low, high), t in ends]
    assert sum(inside) >= 14


def test_errors_are_told_by_channel():
    belief = identify(model(), PRIOR, Trials(ACTION, recorded(0.9)))
    errors = [*belief.diagnostics.errors.values()]
    assert errors[0]["sd"] == pytest.approx(0.02, rel=0.4)
    assert errors[1]["sd"] == pytest.approx(1.0, rel=0.4)
    for e in errors:  # .9 from sample to sample last .47 s
        assert e["white"] < 0.2
        assert 0.2 < e["time"] < 1.2
    assert belief.diagnostics.trustworthy
    assert set(randomization(belief).ranges[0.9]) == {"frequency", "decay", "gain"}
    spread = belief.sample(torch.Size([4000])).double().std(0)
    assert spread.numpy() == pytest.approx(belief.draws.std(0).numpy(), rel=0.1)


@pytest.mark.parametrize(("low", "high", "at"), [(0.6, 1.0, 0), (0.0, 0.05, 1)])
def test_an_interval_at_a_bound_is_one_sided_and_has_a_width(low, high, at):
    """Logs that ask for what is far beyond a bound say nothing of what is within.

    White errors of a hundredth of what is missed leave no width to draws within; of a
    parameter without bounds they leave that of errors as large as the residuals.
    """
    prior = BoxUniform(torch.tensor([1.0, low, 0.5]), torch.tensor([6.0, high, 2.0]))
    belief = identify(model(), prior, Trials(ACTION, recorded()))
    ends, bound = belief.interval()["decay"], (low, high)[at]
    (said,) = (w for w in belief.diagnostics.warnings if w.code == "SA103")
    assert f"{ends[1 - at]:.3g}" in said
    assert ends[at] == pytest.approx(bound, abs=1e-3)
    assert ends[1] - ends[0] > 0.01
    # One-sided: a twentieth of the draws are farther inside.
    inside = (belief.draws[:, 1] - bound).abs().double().numpy()
    assert ends[1] - ends[0] == pytest.approx(np.quantile(inside, 0.95), abs=1e-3)


@pytest.mark.parametrize("times", [30.0, 1e4])
def test_errors_far_beyond_the_declared_one_have_their_size(times):
    """Of any size: not as many times as some largest shape of the error allows."""
    bend = 0.3 * torch.stack([torch.sin(3 * TIMES), 50 * torch.cos(TIMES)], -1)
    x = recorded(extra=bend)
    sd = torch.tensor([0.3, 15.0]) / 2**0.5 / times
    belief = identify(model(GaussianNoise(sd)), PRIOR, Trials(ACTION, x))
    sizes = [e["sd"] for e in belief.diagnostics.errors.values()]
    assert np.log10(np.divide(sizes, times * sd)) == pytest.approx([0, 0], abs=0.6)
    said = [w for w in belief.diagnostics.warnings if w.code == "SA124"]
    told = [float(w.split(" are ")[1].split(" times")[0]) for w in said]
    assert np.log10(np.divide(told, times)) == pytest.approx([0, 0], abs=0.4)
    assert not belief.diagnostics.trustworthy
    free = identify(model(), PRIOR, Trials(ACTION, x)).interval()
    for name, (low, high) in belief.interval().items():
        assert high - low > 0.3 * (free[name][1] - free[name][0])
    right = GaussianNoise(torch.tensor([0.02, 1.0]))
    right = identify(model(right), PRIOR, Trials(ACTION, recorded()))
    assert "SA124" not in [w.code for w in right.diagnostics.warnings]


def test_what_may_be_there_is_found_or_not():
    """A shift of the position beside it: found, and theta as narrow as before."""
    bias = on_outcomes("bias", shift, 0.5)
    extra = torch.tensor([0.1, 0.0])
    for there in (False, True):
        trials = Trials(ACTION, recorded(extra=extra if there else 0.0))
        belief = identify(model(), PRIOR, trials, beside=[bias])
        assert belief.diagnostics.beside["bias"] == pytest.approx(float(there), abs=0.2)
        for (low, high), t in zip(belief.interval(0.999).values(), TRUTH, strict=True):
            assert low < t < high


def test_trials_that_disagree_widen_it():
    """A stiffening spring nobody declared: frequency grows with the amplitude."""
    theta = TRUTH.repeat(4, 1)
    theta[:, 0] += 0.2 * ACTION[:, 0]
    trials = Trials(ACTION, recorded(seed=1, theta=theta))
    belief = identify(model(), PRIOR, trials)
    assert "SA123" in [w.code for w in belief.diagnostics.warnings]
    assert not belief.diagnostics.trustworthy
    low, high = belief.interval()["frequency"]
    assert low < 3.0 < high
    narrow = identify(model(), PRIOR, trials, settings=IdentifySettings(wider=0.0))
    one, two = narrow.interval()["frequency"]
    assert two - one < 0.2 * (high - low)


@pytest.mark.parametrize("are_shared", [True, False])
def test_errors_that_trials_share_count_once(are_shared):
    """Intervals were half as wide as they had to be, and said to be trustworthy."""
    rng, times = np.random.default_rng(3), torch.arange(100) / 25
    error = 0.02 * rng.standard_normal((1 if are_shared else 4, 100))
    x = 2.0 * torch.exp(-0.8 * times) + torch.tensor(error).float().expand(4, -1)
    line = SimulatorModel(
        lambda theta, xi: xi * torch.exp(-theta * times), sample_times=times
    )
    trials = Trials(torch.full((4, 1), 2.0), x)
    belief = identify(line, BoxUniform(torch.zeros(1), torch.full((1,), 3.0)), trials)
    slope = 2.0 * times * torch.exp(-0.8 * times)
    one = 0.02 / slope.square().sum().sqrt().item()  # of a single trial
    low, high = belief.interval()["theta_1"]
    width = 2 * norm.ppf(0.975) * one * (1.0 if are_shared else 0.5)
    assert high - low == pytest.approx(width, rel=0.15)
    codes = [w.code for w in belief.diagnostics.warnings]
    assert codes == ["SA123"] * are_shared


def test_a_prior_of_any_shape_counts():
    """Draws of a gain that nothing tells are those of its skewed prior."""
    shapes, rates = torch.tensor([3.0, 30.0]), torch.tensor([1.0, 30.0])
    own = Independent(Gamma(shapes, rates), 1)

    def deaf(theta, action):
        rest = TRUTH[1:].expand(len(theta), 2)
        return mean(torch.cat([theta[:, :1], rest], 1), action)

    names = ["frequency", "nothing"]
    deaf_model = SimulatorModel(deaf, sample_times=TIMES, parameter_names=names)
    belief = identify(deaf_model, own, Trials(ACTION, recorded()))
    expected = gamma(30, scale=1 / 30).ppf([0.025, 0.975])
    assert [*belief.interval()["nothing"]] == pytest.approx(expected, abs=0.12)
    low, high = belief.interval(0.999)["frequency"]
    assert low < 3.0 < high


def test_a_sign_that_no_trajectory_tells_is_open():
    """Intervals were those of the sign that the search happened to find."""
    times = torch.linspace(0, 4, 100)

    def swing(theta, xi):
        return xi * torch.cos(theta * times)

    model = SimulatorModel(swing, noise=GaussianNoise(0.05), sample_times=times)
    prior = BoxUniform(torch.tensor([-3.0]), torch.tensor([3.0]))
    gen, xi = torch.Generator().manual_seed(0), torch.tensor([[1.0], [2.0], [0.7]])
    x = swing(torch.full((3, 1), 1.5), xi)
    trials = Trials(xi, x + 0.05 * torch.randn(x.shape, generator=gen))
    settings = IdentifySettings(starts_each=8.0)
    belief = identify(model, prior, trials, settings=settings)
    slope = xi * times * torch.sin(1.5 * times) / 0.05
    exact, rate = slope.square().sum().item() ** -0.5, belief.draws[:, 0]
    assert rate.abs().mean().item() == pytest.approx(1.5, abs=4 * exact)
    assert rate.abs().std().item() == pytest.approx(exact, rel=0.1)
    assert (rate > 0).float().mean().item() == pytest.approx(0.5, abs=0.1)
    assert belief.diagnostics.trustworthy


def test_small_matrices_are_not_shared_by_threads():
    """A second thread spins: it made three of four CPU seconds of a robot's belief."""
    before, seen = torch.get_num_threads(), []

    def watched(theta, action):
        seen.append(torch.get_num_threads())
        return mean(theta, action)

    trials = Trials(ACTION, recorded())
    torch.set_num_threads(2)
    try:
        identify(model(fn=watched), PRIOR, trials)
        assert {*seen} == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
