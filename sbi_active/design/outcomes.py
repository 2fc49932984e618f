r"""Outcomes of several actions as one outcome, and summaries of long ones.

.. math::
    I(\theta; x \mid \xi, \text{others}) = I(\theta; x, x_1, \ldots, x_p)
    - I(\theta; x_1, \ldots, x_p)

is what an action tells beyond p others that are under way or chosen. Estimators from
outcomes and their noise take the joint outcome as any other. A likelihood is a product
over the actions. A posterior or a ratio learned for single outcomes says nothing of
joint ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.simulation import NoiseModel


def join_outcomes(
    candidates: CandidateSimulations, others: CandidateSimulations
) -> CandidateSimulations:
    """Return candidates' outcomes with those of p others.

    Args:
        candidates: x of shape (a, n, *x_shape).
        others: Simulations of p actions at the same parameters, with noise of their
            own.

    Returns:
        x of shape (a, n, 1 + p, *x_shape), the candidate's first; actions of shape
        (a, (1 + p) * action_dim).
    """
    a, p = len(candidates.action), len(others.action)
    beside = others.action.flatten().expand(a, -1)

    parts: dict[str, Any] = {}
    for name in ("x", "mean", "replicate"):
        own, other = getattr(candidates, name), getattr(others, name)
        if own is not None and other is not None:
            other = other.transpose(0, 1).expand(a, -1, p, *other.shape[2:])
            parts[name] = torch.cat([own[:, :, None], other], 2)
    if candidates.missing is not None or others.missing is not None:
        parts["missing"] = ~candidates.counted | ~others.counted.all(0)
    action = torch.cat([candidates.action, beside], 1)
    noise = None if candidates.noise is None else _JointNoise(candidates.noise)
    return replace(candidates, action=action, noise=noise, **parts)


def conditional_gain(
    estimator: InformationGainEstimator,
    model: Any,
    simulations: CandidateSimulations,
    belief: Distribution | None,
    num_others: int,
) -> Tensor:
    """Return contributions to what candidates tell beyond the others, (a, n).

    The simulations come from :func:`join_outcomes`; the model is a
    :class:`JointLikelihood`, or None.
    """
    action_dim = simulations.action.shape[1] // (1 + num_others)
    one = simulations.candidates(torch.tensor([0]))
    parts = {k: v[:, :, 1:] for k, v in one.parts().items() if k != "missing"}
    others = replace(one, action=one.action[:, action_dim:], **parts)
    known = estimator(model, others, belief)
    return estimator(model, simulations, belief) - known


class JointLikelihood:
    r"""Likelihood of several outcomes, :math:`\prod_k q(x_k | \theta, \xi_k)`."""

    def __init__(self, model: Any, action_dim: int) -> None:
        self.model, self.action_dim = model, action_dim

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return log densities, shape (n,), of x (n, k, *x_shape), action (n, k d)."""
        actions = action.split(self.action_dim, 1)
        terms = [
            self.model.log_likelihood(x[:, k], theta, part).double()
            for k, part in enumerate(actions)
        ]
        return torch.stack(terms).sum(0)


class _JointNoise(NoiseModel):
    """Noise that is independent from outcome to outcome, each of the same model."""

    def __init__(self, each: NoiseModel) -> None:
        self.each, self.is_known_gaussian = each, each.is_known_gaussian

    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        return self.each.sample(mean.flatten(0, 1), seeds).reshape(mean.shape)

    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        stacked = x.flatten(0, 1), mean.expand_as(x).flatten(0, 1)
        return self.each.log_prob(*stacked).reshape(x.shape[:2]).sum(1)

    def whiten(self, value: Tensor) -> Tensor:
        return self.each.whiten(value.flatten(0, 1)).reshape(value.shape)


class LinearSummaries:
    r"""Summaries of outcomes with many numbers, action by action.

    Around a noise-free outcome f with noise of covariance C, the likelihood of x given
    any parameters depends on :math:`C^{-1/2} x` along the differences of
    :math:`C^{-1/2} f(\theta)` alone. The summaries are these along the leading
    principal directions of f over the belief, one set an action, with independent noise
    of unit size. What the others tell is at most half their variance, in nats:

    .. math::
        I(\theta; x) - I(\theta; s) \le \tfrac12 \log |1 + \Lambda| \le
        \tfrac12 \operatorname{tr} \Lambda .

    Args:
        noise: Gaussian noise of which nothing is unknown.
        num_kept: Number of summaries, beyond the noise where an action has fewer
            directions. Half suffices for most trajectories; twice cost as much more.
        num_rows: Outcomes of an action behind its directions. As many directions can be
            told at most.

    Attributes:
        left_out: Largest information that the summaries of an action leave out, nats,
            by the outcomes so far: a few hundred that the directions were fitted to
            among them, so that it is low where an action has few.
    """

    def __init__(
        self, noise: NoiseModel, *, num_kept: int = 32, num_rows: int = 192
    ) -> None:
        self.left_out = 0.0
        self._noise, self._num_kept, self._num_rows = noise, num_kept, num_rows
        # Mean of the whitened outcomes of an action (N,), their directions (k, N).
        self._known: dict[bytes, tuple[Tensor, Tensor]] = {}

    def __call__(self, action: Tensor, mean: Tensor) -> Tensor:
        """Return summaries, shape (n, k), NaN of an outcome that lacks any number.

        Args:
            action: Action, shape (action_dim,).
            mean: Noise-free outcomes at it, shape (n, *x_shape).
        """
        found = torch.full((len(mean), self._num_kept), torch.nan).double()
        key, white = action.numpy().tobytes(), self._noise.whiten(mean).flatten(1)
        whole = white.isfinite().all(1)
        if not bool(whole.any()):
            return found
        if key not in self._known:
            some = white[whole][: self._num_rows]
            center = some.mean(0)
            self._known[key] = center, leading(some - center, self._num_kept)
        center, directions = self._known[key]
        off = white[whole] - center
        short = off @ directions.T
        lost = 0.5 * float((off.square().sum(1) - short.square().sum(1)).mean())
        self.left_out = max(self.left_out, lost)
        padding = 0, self._num_kept - short.shape[1]
        found[whole] = torch.nn.functional.pad(short, padding)
        return found

    def note(self, num_numbers: int) -> str:
        """Return a note on what is compared in place of how many numbers."""
        return (
            f"{self._num_kept} linear summaries stand for the {num_numbers} numbers of "
            f"an outcome, and leave out about {self.left_out:.2g} nats"
        )


def leading(rows: Tensor, num: int) -> Tensor:
    """Return orthonormal leading directions (num, N) at most, of rows (n, N), n << N.

    Uses inner products of the rows, which takes a tenth of the time of their SVD.
    """
    vectors = torch.linalg.eigh(rows @ rows.T).eigenvectors.flip(1)[:, :num]
    return torch.linalg.qr(rows.T @ vectors).Q.T.contiguous()
