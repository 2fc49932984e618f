"""Error of the information that comes from the error of a learned model."""

from __future__ import annotations

import torch
from torch import Tensor


def learning_error(
    slope: Tensor, z: Tensor, difference: Tensor, residual: Tensor, share: Tensor
) -> Tensor:
    r"""Return the effect of each pair's noise on the information, to first order.

    With :math:`x = f(\theta) + \epsilon`, standard normal noise, and errors
    :math:`\delta f` of the mean and :math:`\delta S` of the covariance,

    .. math::
        \delta I = E[(x - E[f | x])^\top \delta f(\theta)]
        - \tfrac12 \mathrm{tr}\, E[\mathrm{Cov}(f | x)]\, \delta S.

    Both expectations are those of a linear f around each :math:`\theta_i` and a
    Gaussian belief of precision P, with J the slope,

    .. math::
        E[f - E[f | x]] = G_i P (z_i - \bar z), \qquad
        \mathrm{Cov}(f | x) = G_i J_i^\top, \qquad
        G_i = J_i (J_i^\top J_i + P)^{-1}.

    :math:`\delta f` is the smoothed residual, :math:`\delta S` the mean of
    :math:`d d^\top - 1` over the pairs' differences d.

    Args:
        slope: J, shape (n, q, d).
        z: Coordinates of the parameters, shape (n, d).
        difference: d, shape (n, q); zero for incomplete pairs.
        residual: Residual of the pairs' averages, shape (n, q); zero if there is
            none.
        share: Share of a pair that is complete, shape (n,).

    Returns:
        Shape (n,), nats, of mean zero; it adds to errors and leaves the estimate.

    References:
        Palomar & Verdu, IEEE Transactions on Information Theory 2006 (the gradient of
        mutual information).
    """
    d = z.shape[1]
    spread = torch.cov(z.T).reshape(d, d) + 1e-9 * torch.eye(d)
    precision = torch.linalg.inv(spread)
    gain = torch.linalg.solve(slope.mT @ slope + precision, slope.mT).mT  # (n, q, d)
    pull = (gain @ ((z - z.mean(0)) @ precision)[..., None])[..., 0]
    by_mean = share * (pull * residual).sum(1)
    weight = (share / share.sum())[:, None, None]
    moment = ((gain * weight).transpose(0, 1).flatten(1)) @ (
        slope.transpose(0, 1).flatten(1).T
    )
    pairs = (share == 1).double()
    square = ((difference @ moment) * difference).sum(1) - moment.trace() * pairs
    by_noise = -0.5 * square * share.mean() / pairs.mean().clamp_min(1 / len(pairs))
    effect = by_mean + by_noise
    return effect - effect.mean()
