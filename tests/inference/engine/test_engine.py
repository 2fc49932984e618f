"""Posteriors of densities whose normalizers are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from sbi_active.inference.engine import SimulatedPotential, infer, search
from sbi_active.inference.engine import surface as surfaces
from sbi_active.inference.engine.importance import pareto_shape
from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.engine.pool import Pool, PriorDraws
from sbi_active.inference.engine.search import oddity
from sbi_active.inference.engine.settings import Settings, SurfaceSettings
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.inference.sampling.mixtures import StudentMixture


class Given(SimulatedPotential):
    """Residuals in deviations of a Gaussian error.

    Args:
        function: From places (n, dim) to residuals (n, observed).
        dim: Number of coordinates.
        observed: Number of residuals.
        sd: Deviation of the error, for the likelihood's constant.
    """

    def __init__(self, function, dim, observed, *, sd=1.0):
        own = SimpleNamespace(dim=dim, precision=np.ones(dim), center=np.zeros(dim))
        own.low, own.high = np.full((2, dim), [[-8.0], [8.0]])
        own.sample = lambda n, rng: rng.standard_normal((n, dim))
        self.coordinates = own
        self.dim, self.searched = dim, np.ones(dim, dtype=bool)
        self.function, self.num_observed, self.step = function, observed, 3e-3
        self.sd, self.num_trials, self.known = sd, 1, set()

    @property
    def num_rows(self):
        return len(self.known)

    @property
    def num_simulations(self):
        return self.num_rows

    def residual(self, u):
        self.known.update(row.tobytes() for row in u)  # each is simulated once
        return (self.function(u),)

    def simulated(self, u):
        return u

    def log_prior(self, u):
        return -0.5 * (u**2).sum(1) - 0.5 * self.dim * np.log(2 * np.pi)

    def log_likelihood(self, u, *, floor=-np.inf):
        square = (self.residual(u)[0] ** 2).sum(1)
        return -0.5 * square - self.num_observed * np.log(self.sd * np.sqrt(2 * np.pi))

    def splits_off(self, axes, rng):
        return False


# Proposals along ridges


X, SLOPE = 1.0, 0.4


#: For evidences that are precise with few draws.
FEW = Settings(num_effective=100, num_draws=200, share_of_plenty=0)


def product(sd):
    """One number that is the product of a parameter and a gain: a hyperbola."""
    return Given(lambda u: (X - u[:, :1] * np.exp(SLOPE * u[:, 1:])) / sd, 2, 1, sd=sd)


def evidence():
    """Return the log evidence of an error that is small beside the prior."""

    def density(gain):
        scale = np.exp(SLOPE * gain)
        return norm.pdf(gain) * norm.pdf(X / scale) / scale

    return np.log(quad(density, -8, 8)[0])


def spread():
    """Return the standard deviation of the gain."""
    gain = np.linspace(-8, 8, 4_001)
    scale = np.exp(SLOPE * gain)
    weight = norm.pdf(gain) * norm.pdf(X / scale) / scale
    mean = np.average(gain, weights=weight)
    return np.sqrt(np.average((gain - mean) ** 2, weights=weight))


#: Widths, seeds, settings, and simulations at most.
RIDGES = [
    (1e-3, 1, FEW, 12_000),
    (1e-4, 0, Settings(), 30_000),
    (1e-4, 1, Settings(), 30_000),
]


@pytest.mark.parametrize(("sd", "seed", "settings", "most"), RIDGES)
def test_a_ridge_is_followed_however_thin(sd, seed, settings, most):
    """At 1e-4 of the prior few normals along it left gaps, and particles half a nat."""
    own, rng = product(sd), np.random.default_rng(seed)
    found = infer(own, rng, found=search(own, rng), settings=settings)
    assert found.method == "importance"
    assert found.effective_sample_size >= settings.num_effective
    error = 4 * found.standard_error
    assert found.log_evidence == pytest.approx(evidence(), abs=error)
    gain = found.draws(4_000, rng)[:, 1]
    assert gain.std() == pytest.approx(spread(), rel=0.1 if sd < 1e-3 else 0.3)
    assert own.num_rows < most


# Modes and widths by Gauss-Newton steps, where both are known


def test_where_nothing_fits_there_is_a_best_place():
    """Beside a sum of squares of 1e18 some nats are lost in the rounding."""
    own = Given(lambda u: 1e9 + np.stack([u[:, 0], 3 * u[:, 1]], 1), 2, 2)
    found = search(own, np.random.default_rng(0))
    assert len(found.modes) >= 1
    assert np.isfinite(found.guess.factors).all()


@pytest.mark.parametrize(("width", "missed"), [(0.1, 0.5), (1.5, 0.0)])
def test_a_mode_that_draws_miss_is_told_by_those_of_other_proposals(width, missed):
    rng, pool = np.random.default_rng(0), Pool.empty(1)
    given = Given(lambda u: 40 * (u**2 - 1), 1, 1)  # modes at -1 and 1
    for place, scale in ((1.0, width), (-1.0, 1.0)):
        at, factor = np.full((1, 1), place), np.full((1, 1, 1), scale)
        drawn_from = StudentMixture(at, factor, np.ones(1), np.inf)
        drawn = drawn_from.sample(4_000, rng)
        pool.add(drawn_from, drawn, given, is_final=place == 1)
    assert pool.missed == pytest.approx(missed, abs=0.1)


# A narrow mode beside a wide one


def bumped(dim: int, width: float) -> Given:
    """A straight response, and a bump that carries it from -1 to 0.7 in each."""
    at, sd = np.full(dim, -1.0), 0.1

    def residual(u):
        bump = np.exp(-0.5 * ((u - at) ** 2).sum(1, keepdims=True) / width**2)
        # The last number is the wide mode's misfit of two deviations.
        off = np.concatenate([u - 0.7 + 1.7 * bump, 0.2 * (1 - bump)], axis=1)
        return off / sd

    return Given(residual, dim, dim + 1, sd=sd)


def masses(own: Given, *, near: float, num: int = 401) -> tuple[float, float]:
    """Return log integrals around the bump and of all else, by quadrature.

    Without the bump the residuals are straight, and what is around it negligible.
    """
    axis = np.linspace(-1 - near, -1 + near, num)
    u = np.stack(np.meshgrid(*[axis] * own.dim), axis=-1).reshape(-1, own.dim)
    narrow = logsumexp(own.log_prior(u) + own.log_likelihood(u))
    narrow += own.dim * np.log(axis[1] - axis[0])
    wide = own.dim * norm.logpdf(0.7, scale=np.hypot(1, own.sd))
    return float(narrow), wide + norm.logpdf(0.2, scale=own.sd)


@pytest.mark.parametrize("seed", [2, 3, 4])
@pytest.mark.parametrize(("dim", "width"), [(1, 0.03), (2, 0.2)])
def test_a_narrow_mode_beside_a_wide_one_is_found(dim, width, seed):
    """It was lost where the best draws of the prior were all in the wide one."""
    own, rng = bumped(dim, width), np.random.default_rng(seed)
    found = infer(own, rng, found=search(own, rng))
    narrow, wide = masses(own, near=5 * width)
    share = 1 / (1 + np.exp(wide - narrow))
    assert 0.3 < share < 0.7
    error = 4 * found.standard_error
    assert found.log_evidence == pytest.approx(np.logaddexp(narrow, wide), abs=error)
    is_narrow = (found.u < -0.3).all(1)
    assert found.weight[is_narrow].sum() == pytest.approx(share, abs=0.1)


def test_a_draw_is_odd_where_others_do_not_predict_it():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((100, 2))
    around = np.argsort(((u[:, None] - u) ** 2).sum(-1), axis=1)[:, 1:10]
    residual = np.concatenate([1e3 * u, 50 * u[:, :1] ** 2], axis=1)
    residual[7] += 200.0  # less than the response between neighbors
    assert oddity(u, residual, around).argmax() == 7
    residual[7] -= 200.0
    flat = oddity(u, 1e3 * u, around)
    assert flat == pytest.approx(np.zeros(100), abs=1e-3)


# The posterior of a learned likelihood, on densities with known normalizers


def likelihood_of(dim: int, log_likelihood: Any) -> Any:
    """Return a likelihood over a box prior between -1 and 1."""
    prior = BoxUniform(-torch.ones(dim), torch.ones(dim))
    coordinates = PriorCoordinates(prior, np.random.default_rng(0))
    return SimpleNamespace(coordinates=coordinates, log_likelihood=log_likelihood)


def peaks(centers: np.ndarray, sd: np.ndarray) -> Any:
    """Return a log density of integral len(centers) in the plane."""

    def log_density(z: np.ndarray) -> np.ndarray:
        square = (((z[:, None] - centers) / sd) ** 2).sum(-1)
        log_peak = -0.5 * square - np.log(2 * np.pi * sd.prod())
        return np.asarray(logsumexp(log_peak, axis=1))

    return log_density


#: Centers and deviations.
PEAKS = [
    ([[0.2, -0.3]], [1e-4, 1e-4]),
    ([[0.3, 0.0]], [1e-4, 0.2]),
    ([[-0.7, 0.2], [0.7, -0.2]], [1e-3, 1e-2]),
    ([[-0.8, 0.2], [-0.3, 0.2], [0.2, 0.2], [0.7, 0.2]], [0.01, 0.1]),
]


@pytest.mark.parametrize(("centers", "sd"), PEAKS)
def test_finds_narrow_peaks(centers: list, sd: list):
    rng = np.random.default_rng(0)
    place, width = np.array(centers), np.array(sd)
    found = learned_fit(likelihood_of(2, peaks(place, width)), rng)
    effective = found.effective_sample_size
    assert effective > 2_900
    assert found.efficiency > 0.2
    error = 1 / effective**0.5
    exact = np.log(len(place)) - 2 * np.log(2)
    assert found.log_evidence == pytest.approx(exact, abs=4 * error)
    draws = found.draws(4_000, rng)
    nearest = ((draws[:, None] - place) ** 2).sum(-1).argmin(1)
    share = np.bincount(nearest, minlength=len(place)) / 4_000
    assert abs(share - 1 / len(place)).max() < 4 * error


def test_a_density_cut_at_many_edges():
    dim = 12

    # A normal density about a corner of the box, 1 in 2^d of which is within.
    def log_density(z: np.ndarray) -> np.ndarray:
        log_prob = -0.5 * (((z - 1) / 0.2) ** 2).sum(1) - dim * np.log(0.2)
        return log_prob - 0.5 * dim * np.log(np.pi / 2)

    own = likelihood_of(dim, log_density)
    found = learned_fit(own, np.random.default_rng(0), num_effective=63)
    assert found is not None
    effective = found.effective_sample_size
    assert effective > 990
    exact = -dim * np.log(2)
    assert found.log_evidence == pytest.approx(exact, abs=4 / effective**0.5)


PLATEAU = -20.0  # log likelihood where nothing is known
DIM = 4


# A needle that nothing points at is for no sampler.
@pytest.mark.parametrize(
    ("is_known", "width"), [(True, 0.003), (True, 0.05), (False, 0.05)]
)
def test_a_peak_on_a_plateau_is_not_lost(is_known: bool, width: float):
    rng, center = np.random.default_rng(0), np.array([0.5, -0.2, 0.1, 0.6])

    def log_likelihood(z: np.ndarray) -> np.ndarray:
        square = ((z - center) ** 2).sum(1) / (2 * width**2)
        peak = -square - DIM * np.log(width * np.sqrt(2 * np.pi))
        return np.logaddexp(peak, PLATEAU)

    known = center + 5 * width * rng.standard_normal((400, DIM))
    own = likelihood_of(DIM, log_likelihood)
    near = known if is_known else own.coordinates.sample_prior(400, rng)
    found = learned_fit(own, rng, near=near)
    assert found.log_evidence == pytest.approx(-DIM * np.log(2), abs=0.1)
    draws = found.draws(500, rng)
    assert draws.mean(0) == pytest.approx(center, abs=0.3 * width)


@pytest.mark.parametrize("shape", [0.5, 1.0])
def test_pareto_shape_is_that_of_arviz(shape: float):
    arviz = pytest.importorskip("arviz")
    rng = np.random.default_rng(int(10 * shape))
    log_weight = np.log(rng.pareto(1 / shape, 4_000) + 1)
    other = float(arviz.psislw(log_weight)[1])
    assert pareto_shape(log_weight) == pytest.approx(other, abs=0.02)
    assert pareto_shape(log_weight) == pytest.approx(shape, abs=0.25)


# Surfaces of a likelihood, and draws that pass them


SUMS = np.array([0.5, -0.3, 0.8, 0.1, -0.6, 0.4])


def bent(sd=0.2, bend=0.7):
    """Six sums, each of a parameter and the square of the one before."""

    def residual(u):
        before = np.concatenate([np.zeros((len(u), 1)), u[:, :-1]], axis=1)
        return (SUMS - u - bend * before**2) / sd

    return Given(residual, 6, 6, sd=sd)


def evidence_of_bent(sd, bend, num=400_000):
    """Return log Z: the sums are a shear of the parameters, of volume one."""
    sums = SUMS + sd * np.random.default_rng(0).standard_normal((num, 6))
    u = np.zeros_like(sums)
    u[:, 0] = sums[:, 0]
    for k in range(1, 6):
        u[:, k] = sums[:, k] - bend * u[:, k - 1] ** 2
    log_prior = -0.5 * (u**2).sum(1) - 3 * np.log(2 * np.pi)
    return float(logsumexp(log_prior) - np.log(num))


def test_a_polynomial_response_is_predicted_where_no_draw_was():
    own, rng = bent(), np.random.default_rng(0)
    pool = Pool.empty(6)
    u = SUMS + 0.5 * rng.standard_normal((500, 6))
    pool.add(PriorDraws(own), u, own)
    settings = SurfaceSettings(depth=np.inf)
    surface = surfaces.fitted_surface(own, lambda r: r, pool, rng, settings)
    assert surface is not None
    assert surface.degree == 2
    assert surface.efficiency == pytest.approx(1.0, abs=1e-6)
    far = 2 * rng.standard_normal((50, 6))
    assert surface.log_likelihood(far) == pytest.approx(own.log_likelihood(far))


def test_few_draws_have_no_surface():
    own, rng = bent(), np.random.default_rng(0)
    pool = Pool.empty(6)
    pool.add(PriorDraws(own), SUMS + 0.1 * rng.standard_normal((10, 6)), own)
    few = own, lambda r: r, pool, rng, SurfaceSettings()
    assert surfaces.fitted_surface(*few) is None


@pytest.mark.parametrize("shift", [0.0, 1.0, 30.0])
def test_weights_are_right_whatever_the_surface(shift):
    """The surface's posterior is off by none, one and thirty deviations."""
    dim, sd, rng = 3, 0.5, np.random.default_rng(3)
    target = multivariate_normal(np.zeros(dim), sd**2 * np.eye(dim))
    normal = multivariate_normal(np.zeros(dim), np.eye(dim))
    prior = SimpleNamespace(dim=dim, log_prior=normal.logpdf)
    off = np.concatenate([np.full((dim, 1), -shift), np.eye(dim) / sd], axis=1)
    surface = surfaces.Surface(np.zeros(dim), np.eye(dim), 1, off, 0.0, 1.0)
    base = StudentMixture(np.zeros((1, dim)), np.eye(dim)[None])
    own = SurfaceSettings()
    known = surfaces.SurfacePotential(prior, surface)
    passed = surfaces.Screened(base, known).leveled(rng, own)
    u = passed.sample(20_000, rng)
    weight = np.exp(target.logpdf(u) - passed.log_prob(u))
    error = np.hypot(weight.std() / len(u) ** 0.5, passed.error)
    assert weight.mean() == pytest.approx(1.0, abs=4 * error)
    assert error < 0.05
    mean = (weight[:, None] * u).sum(0) / weight.sum()
    assert np.abs(mean).max() < 0.05


def test_most_draws_of_a_bent_posterior_count():
    own, rng = bent(0.1, 2.0), np.random.default_rng(1)
    found = infer(own, rng, found=search(own, rng))
    assert isinstance(found.final, surfaces.Screened)
    exact = evidence_of_bent(0.1, 2.0)
    assert 0 < found.final.error < found.standard_error
    error = 4 * found.standard_error + 0.01  # of the reference's own draws
    assert found.log_evidence == pytest.approx(exact, abs=error)
    assert found.effective_sample_size > 0.5 * found.num_drawn
    assert found.tail_shape < 0.7


def test_a_search_ends_at_the_bottom_of_a_bent_valley():
    own = bent(sd=0.01)
    start = np.full((1, 6), 2.0)
    end, cost = descend(own, start, lambda r: r, 3e-3, 30)
    assert (own.residual(end)[0] ** 2).sum() + (end**2).sum() == pytest.approx(cost[0])
    again, _ = descend(own, end, lambda r: r, 3e-3, 30)
    assert again == pytest.approx(end, abs=1e-3)
