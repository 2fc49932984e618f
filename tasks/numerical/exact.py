r"""Exact posterior, predictive and information gain of the numerical model.

.. math::
    x = g(\theta_1)\, e^{3 - \xi} + \theta_2\, \xi + \varepsilon, \qquad
    \varepsilon \sim \mathcal N(0, 1), \quad \theta \sim \mathcal U[-5, 5]^2.

The yardstick of every approximation: nothing here is fitted or sampled but the draws
asked for. The integrals are those of `exact_evidence`.
"""

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.special import log_ndtr, ndtri_exp, xlogy
from torch import Tensor

from sbi_active.tasks.numerical.exact_evidence import (
    BOUND,
    LOG_SQRT_2PI,
    REACH,
    RESPONSES,
    Array,
    Response,
    integrate,
    legendre_nodes,
    log_evidence,
    log_normal_mass,
    profile,
)

__all__ = ["ExactPosterior", "noise_free"]

NOISE_ENTROPY = LOG_SQRT_2PI + 0.5
PANEL = 13.0  # width of a panel of 16 nodes, in noise standard deviations
BLOCK = 2**17  # quadrature nodes held in memory at once


class ExactPosterior:
    r"""The posterior :math:`p(\theta \mid \mathcal D)` and what it predicts.

    Args:
        action: :math:`\xi`, shape (t,) or (t, 1), any values in [-5, 5], repeated or
            not. No trials (t = 0) give the prior.
        x: Observations, shape (t,) or (t, 1).
        variant: "linear" (:math:`g = \theta_1`), "sinh"
            (:math:`g = 5 \sinh(\theta_1 / 2.5) / \sinh 2`) or "square"
            (:math:`g = \theta_1^2 / 2.5 - 5`, two equal modes).

    Raises:
        ValueError: If shapes differ, an action is out of range, a value is not finite
            or the variant is unknown.

    Example:
        >>> posterior = ExactPosterior([-5.0, 5.0], [-8948.0, 4.6])
        >>> posterior.log_prob(torch.tensor([[-3.0, 1.0], [3.0, 1.0]])) > 0
        tensor([ True, False])
    """

    def __init__(
        self,
        action: Tensor | ArrayLike,
        x: Tensor | ArrayLike,
        *,
        variant: str = "linear",
    ) -> None:
        self._response = find_response(variant)
        self.variant = variant
        self.action = as_actions(action)
        self.x = _as_vector(x, "x")
        if self.action.size != self.x.size:
            raise ValueError(
                f"expected one x an action; got {self.action.size} actions and "
                f"{self.x.size} x; pass both of shape (t,) or (t, 1)"
            )
        evidence, low, high = log_evidence(self._response, self.action, self.x[None])
        self.log_evidence = float(evidence[0])
        self._low, self._high = float(low[0]), float(high[0])

    def log_prob(self, theta: Tensor | ArrayLike) -> Tensor:
        r"""Log density with respect to :math:`\theta`, normalized.

        Args:
            theta: Parameters, shape (n, 2).

        Returns:
            Log density in nats, shape (n,); -inf outside the box.
        """
        residual = self.x - noise_free(theta, self.action, variant=self.variant).numpy()
        log_likelihood = (-0.5 * residual**2 - LOG_SQRT_2PI).sum(1)
        inside = (abs(as_parameters(theta)) <= BOUND).all(1)
        log_prior = np.where(inside, -2 * np.log(2 * BOUND), -np.inf)
        return torch.from_numpy(log_likelihood + log_prior - self.log_evidence)

    def sample(
        self, num_samples: int, *, seed: int | np.random.Generator | None = None
    ) -> Tensor:
        r"""Independent draws: :math:`\theta_1` first, then :math:`\theta_2` given it.

        Args:
            num_samples: Number of draws n.
            seed: Seed or generator; None draws fresh entropy.

        Returns:
            Parameters, shape (n, 2).
        """
        rng = np.random.default_rng(seed)
        grid = np.linspace(self._low, self._high, 2**14 + 1)
        density = self._density(grid)
        cdf = np.append(0.0, np.cumsum(density[1:] + density[:-1]))
        theta_1 = np.interp(rng.random(num_samples) * cdf[-1], cdf, grid)

        mean, _, sd = self._profile(theta_1)
        side = np.where(mean < 0, -1.0, 1.0)  # mirror: Phi is precise in its lower tail
        a, b = (-BOUND - side * mean) / sd, (BOUND - side * mean) / sd
        log_u = np.log1p(-rng.random(num_samples))
        z = ndtri_exp(np.logaddexp(log_ndtr(a), log_u + log_normal_mass(a, b)))
        theta_2 = np.clip(mean + sd * side * z, -BOUND, BOUND)

        if self._response.even:
            theta_1 = theta_1 * rng.choice([-1.0, 1.0], num_samples)
        return torch.from_numpy(np.stack([theta_1, theta_2], 1))

    def mass_positive(self) -> float:
        r""":math:`P(\theta_1 > 0 \mid \mathcal D)`; one half where g is even."""
        if self._response.even:
            return 0.5
        low, high = max(self._low, 0.0), max(self._high, 0.0)
        theta_1, weight = legendre_nodes(low, high, 16)
        return min(1.0, float(weight @ self._density(theta_1)))

    def log_predictive(self, x: Tensor | ArrayLike, action: float | Tensor) -> Tensor:
        r"""Log density of the next observation, a ratio of evidences.

        .. math::
            \log p(x \mid \xi, \mathcal D) = \log p(\mathcal D, x) - \log p(\mathcal D)

        Args:
            x: Observations, shape (n,) or (n, 1).
            action: One action :math:`\xi`.

        Returns:
            Log density in nats, shape (n,).
        """
        further = _as_vector(x, "x")
        actions = np.append(self.action, as_actions([float(action)]))
        trials = np.column_stack([np.tile(self.x, (further.size, 1)), further])
        blocks = np.array_split(trials, 1 + further.size // 1000)
        evidence = [log_evidence(self._response, actions, block)[0] for block in blocks]
        return torch.from_numpy(np.concatenate(evidence) - self.log_evidence)

    def expected_information_gain(self, action: Tensor | ArrayLike) -> Tensor:
        r"""Expected information gain of one more trial about :math:`\theta`.

        .. math::
            \mathrm{EIG}(\xi) = H[x \mid \xi, \mathcal D] - H[\varepsilon]

        Accurate to about 1e-5. The gains under the prior are kept for the life of the
        process.

        Args:
            action: :math:`\xi`, shape (a,) or (a, 1).

        Returns:
            Gain in nats, shape (a,).
        """
        gain = [
            self._gain(xi) if self.x.size else _prior_gain(self.variant, xi)
            for xi in as_actions(action).tolist()
        ]
        return torch.tensor(gain, dtype=torch.float64)

    def _gain(self, action: float) -> float:
        """Entropy of the predictive less that of the noise.

        The posterior is put on nodes close enough for the noise to blur them, their
        noise-free outcomes shared between the two points beside them on a grid of x,
        and the grid is convolved with the noise through its characteristic function.
        Sharing widens the predictive by 1e-5 of its variance.
        """
        slope = np.exp(3 - action)
        width = slope * self._response.steepest * (self._high - self._low)
        theta_1, weight_1 = legendre_nodes(
            self._low, self._high, max(16, int(width / PANEL) + 1)
        )
        mean, log_peak, sd = self._profile(theta_1)
        peak = np.clip(mean, -BOUND, BOUND)
        outside = abs(mean - peak) / sd
        reach = sd * (np.hypot(REACH, outside) - outside)
        low, high = np.maximum(peak - reach, -BOUND), np.minimum(peak + reach, BOUND)
        num_panels = max(3, int(abs(action) * (high - low).max() / PANEL) + 1)

        first = slope * self._response.curve(theta_1)
        left = (first + np.minimum(action * low, action * high)).min() - REACH
        right = (first + np.maximum(action * low, action * high)).max() + REACH
        step = float(np.clip((right - left) / 5000, 0.01, 0.1))
        num_steps = int((right - left) / step) + 2

        mass = np.zeros(num_steps)
        num_blocks = 1 + 16 * num_panels * theta_1.size // BLOCK
        for i in np.array_split(np.arange(theta_1.size), num_blocks):
            theta_2, weight_2 = legendre_nodes(low[i], high[i], num_panels)
            chi = (theta_2 - mean[i, None]) / sd
            posterior = np.exp(log_peak[i, None] - 0.5 * chi**2 - self.log_evidence)
            weight = (weight_1[i, None] * weight_2 * posterior).ravel()
            place = (first[i, None] + action * theta_2 - left).ravel() / step
            below = place.astype(np.intp)
            above = weight * (place - below)
            mass += np.bincount(below, weight - above, num_steps)
            mass += np.bincount(below + 1, above, num_steps)
        assert abs(mass.sum() - 1) < 1e-4, f"predictive integrates to {mass.sum()}"

        k = 2 * np.pi * np.fft.rfftfreq(num_steps, step)
        noise = np.exp(-0.5 * k**2)
        density = np.fft.irfft(np.fft.rfft(mass / step) * noise, num_steps)
        density = np.maximum(density, 0.0)  # rounding leaves -1e-17
        return float(-xlogy(density, density).sum() * step - NOISE_ENTROPY)

    def _density(self, theta_1: Array) -> Array:
        """Marginal density of theta_1, folded onto [0, 5] where g is even."""
        return np.exp(integrate(*self._profile(theta_1)) - self.log_evidence)

    def _profile(self, theta_1: Array) -> tuple[Array, Array, float]:
        mean, log_peak, sd = profile(
            self._response, theta_1[None], self.action, self.x[None]
        )
        return mean[0], log_peak[0], sd


@lru_cache(maxsize=1024)
def _prior_gain(variant: str, action: float) -> float:
    return ExactPosterior([], [], variant=variant)._gain(action)


def noise_free(
    theta: Tensor | ArrayLike, action: Tensor | ArrayLike, *, variant: str = "linear"
) -> Tensor:
    r"""Noise-free outcome :math:`f_\xi(\theta) = g(\theta_1) e^{3-\xi} + \theta_2 \xi`.

    Args:
        theta: Parameters, shape (n, 2).
        action: :math:`\xi`, shape (a,) or (a, 1).
        variant: The curve g.

    Returns:
        Outcomes, shape (n, a).
    """
    parameters, xi = as_parameters(theta), as_actions(action)
    g = find_response(variant).curve(parameters[:, :1])
    return torch.from_numpy(g * np.exp(3 - xi) + parameters[:, 1:] * xi)


def find_response(variant: str) -> Response:
    """The curve g of a variant; the error for an unknown one lists the valid names."""
    if variant not in RESPONSES:
        raise ValueError(
            f"expected a variant among {', '.join(RESPONSES)}; got {variant!r}; "
            "choose one of these"
        )
    return RESPONSES[variant]


def as_actions(action: Tensor | ArrayLike) -> Array:
    """Actions of shape (a,) or (a, 1) as a checked array of shape (a,)."""
    vector = _as_vector(action, "action")
    if (abs(vector) > BOUND).any():
        raise ValueError(
            f"expected actions in [-5, 5]; got {vector[abs(vector).argmax()]:g}; "
            "keep to the range of the task"
        )
    return vector


def as_parameters(theta: Tensor | ArrayLike) -> Array:
    """Parameters as a checked array of shape (n, 2)."""
    rows = as_array(theta)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise ValueError(
            f"expected theta of shape (n, 2); got {rows.shape}; pass one row a draw"
        )
    return rows


def as_array(values: Tensor | ArrayLike) -> Array:
    """A float64 copy, off the graph and on the CPU."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return np.array(values, dtype=np.float64)


def _as_vector(values: Tensor | ArrayLike, name: str) -> Array:
    vector = as_array(values)
    if vector.ndim != 1 and (vector.ndim != 2 or vector.shape[1] != 1):
        raise ValueError(
            f"expected {name} of shape (n,) or (n, 1); got {vector.shape}; pass one "
            "number a trial"
        )
    if not np.isfinite(vector).all():
        raise ValueError(f"expected finite {name}; got nan or inf; drop such trials")
    return vector.ravel()
