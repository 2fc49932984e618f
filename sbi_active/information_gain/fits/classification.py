"""Cross-fitted classification: what parameters tell about a label, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from sbi_active.information_gain.fits.cross_fitting import NUM_FOLDS
from sbi_active.information_gain.fits.emulator import kernel, whitening

NUM_KNOTS = 12  # of the radial features
NUM_STEPS = 25  # of Newton's method at most
MAX_MOVE = 4.0  # of a logit in one step, lest separable labels run away
CONVERGED = 1e-6  # of a logit in one step
#: Features and precision of the coefficients' Gaussian prior; held-out rows choose.
OPTIONS = (
    ("linear", 0.01),
    ("linear", 1.0),
    ("quadratic", 0.01),
    ("quadratic", 1.0),
    ("radial", 0.1),
)


@dataclass(frozen=True)
class ParameterFeatures:
    """Low-order features of whitened parameters.

    Attributes:
        center: Center of the parameters, shape (d,).
        transform: Whitening transform, shape (d, d).
        knots: Whitened parameters at the center of a radial feature, shape (k, d).
    """

    center: Tensor
    transform: Tensor
    knots: Tensor

    @staticmethod
    def fit(theta: Tensor) -> ParameterFeatures:
        """Take location, scale and knots from parameters, shape (n, d)."""
        center, transform = whitening(theta)
        return ParameterFeatures(
            center, transform, (theta[:NUM_KNOTS] - center) @ transform
        )

    def __call__(self, theta: Tensor, kind: str) -> Tensor:
        """Return features with a leading one, (n, d) -> (n, p).

        They are "linear", "quadratic", or "radial", each with those before it.
        """
        z = (theta - self.center) @ self.transform
        parts = [torch.ones(len(z), 1, dtype=z.dtype), z]
        if kind != "linear":
            i, j = torch.triu_indices(z.shape[1], z.shape[1])
            parts.append(z[:, i] * z[:, j])
        if kind == "radial":
            parts.append(kernel(z, self.knots))
        return torch.cat(parts, 1)


def cross_fitted(
    theta: Tensor, label: Tensor, other: Tensor, weight: Tensor
) -> tuple[Tensor, list[int]]:
    r"""Return held-out log probabilities of binary labels given the parameters.

    .. math::
        \log q(v_i | \theta_i, w_i), \qquad q = \sigma(\beta^\top \phi(\theta) +
        \gamma^\top w)

    w is anything independent of v given the parameters, such as the label of a
    replicate: it then adds no information to them, and stands in for what the features
    do not catch. Every row is scored by a q fitted to the other folds; the features
    and the ridge are chosen on rows outside its fold.

    Args:
        theta: Parameters, shape (n, d).
        label: 0 or 1, shape (a, c, n): a candidates, c outcomes a parameter set.
        other: w, shape (a, c, n, k).
        weight: 0 leaves a row out of the fit and the choice, shape (a, c, n).

    Returns:
        The log probabilities, shape (a, c, n), and the choice over all rows of each
        candidate, an index of ``OPTIONS``.
    """
    features = ParameterFeatures.fit(theta)
    fold = torch.arange(len(theta)) % NUM_FOLDS
    scores = []
    for kind, ridge in OPTIONS:
        base = features(theta, kind).expand(*label.shape, -1)
        phi = torch.cat([base, other], -1)
        score = torch.empty_like(label)
        for k in range(NUM_FOLDS):
            train, test = fold != k, fold == k
            rows = [p[:, :, train].flatten(1, 2) for p in (phi, label, weight)]
            coefficient = fit_logistic(rows[0], rows[1], rows[2], ridge)
            logit = torch.einsum("acnp,ap->acn", phi[:, :, test], coefficient)
            sign = 2 * label[:, :, test] - 1
            score[:, :, test] = logsigmoid(sign * logit)
        scores.append(score)
    stacked = torch.stack(scores)  # (option, a, c, n)
    weighted = (stacked * weight).sum(2)
    result = torch.empty_like(label)
    for k in range(NUM_FOLDS):
        best = weighted[:, :, fold != k].sum(-1).argmax(0)
        chosen = stacked[best, torch.arange(len(label))]
        result[:, :, fold == k] = chosen[:, :, fold == k]
    return result, weighted.sum(-1).argmax(0).tolist()


def probability(
    theta: Tensor, label: Tensor, weight: Tensor
) -> Callable[[Tensor], Tensor]:
    """Return a smooth log probability of a label, of parameters (k, d) -> (k,).

    It is fitted to parameters (n, d) and labels 0 or 1, shape (c, n); weight 0 leaves a
    row out.
    """
    nothing = torch.zeros(1, *label.shape, 0, dtype=label.dtype)
    _, (best,) = cross_fitted(theta, label[None], nothing, weight[None])
    kind, ridge = OPTIONS[best]
    features = ParameterFeatures.fit(theta)
    phi = features(theta, kind).repeat(len(label), 1)
    coefficient = fit_logistic(
        phi[None], label.reshape(1, -1), weight.reshape(1, -1), ridge
    )[0]
    return lambda new: logsigmoid(features(new, kind) @ coefficient)


def fit_logistic(phi: Tensor, label: Tensor, weight: Tensor, ridge: float) -> Tensor:
    r"""Return the penalized maximum of the logistic likelihood, (a, p), by Newton.

    .. math::
        \sum_i w_i \log \sigma((2 y_i - 1)\, \beta^\top \phi_i)
        - \tfrac\lambda2 \sum_{j > 0} \beta_j^2

    with features phi (a, r, p), the first a one, labels y of 0 or 1 and weights w (a,
    r).

    References:
        Bishop, Pattern Recognition and Machine Learning, 2006, section 4.3.3.
    """
    num_features = phi.shape[-1]
    penalty = torch.full((num_features,), ridge, dtype=phi.dtype)
    penalty[0] = 1e-3  # a label that never occurs has no maximum without it
    coefficient = torch.zeros(len(phi), num_features, dtype=phi.dtype)
    logit = torch.zeros_like(label)
    for _ in range(NUM_STEPS):
        mean = logit.sigmoid()
        gradient = torch.einsum("arp,ar->ap", phi, weight * (label - mean))
        gradient = gradient - penalty * coefficient
        curvature = weight * (mean * (1 - mean)).clamp_min(1e-9)
        hessian = (phi * curvature[..., None]).mT @ phi + torch.diag(penalty)
        step = torch.linalg.solve(hessian, gradient[..., None])[..., 0]
        move = torch.einsum("arp,ap->ar", phi, step)
        shrink = (MAX_MOVE / move.abs().amax(1).clamp_min(1e-30)).clamp_max(1.0)
        coefficient = coefficient + shrink[:, None] * step
        logit = logit + shrink[:, None] * move
        if float(move.abs().max()) < CONVERGED:
            break
    return coefficient
