r"""Few numbers in place of the many of an outcome, for what an action tells.

Around a noise-free outcome f with noise of covariance C, the likelihood of x given any
parameters depends on :math:`C^{-1/2} x` along the differences of
:math:`C^{-1/2} f(\theta)` alone. The summaries are these along the leading principal
directions of f over the belief, one set an action, with independent noise of unit size.
What the others tell is at most half their variance, in nats:

.. math::
    I(\theta; x) - I(\theta; s) \le \tfrac12 \log |1 + \Lambda| \le
    \tfrac12 \operatorname{tr} \Lambda .
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.simulation import GaussianNoise, NoiseModel
from sbi_active.simulation.noise.whitening import whitened


@dataclass(frozen=True)
class _Directions:
    """Principal directions of the outcomes of one action.

    Attributes:
        center: Mean of the whitened outcomes, shape (N,).
        rows: Orthonormal directions, shape (k, N).
    """

    center: Tensor
    rows: Tensor


class LinearSummaries:
    """Summaries of outcomes with many numbers, action by action.

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
        self._known: dict[bytes, _Directions] = {}

    @property
    def noise(self) -> GaussianNoise:
        """The noise of the summaries."""
        return GaussianNoise(1.0)

    def __call__(self, action: Tensor, mean: Tensor) -> Tensor:
        """Return summaries, shape (n, k), NaN of an outcome that lacks any number.

        Args:
            action: Action, shape (action_dim,).
            mean: Noise-free outcomes at it, shape (n, *x_shape).
        """
        white = whitened(self._noise, mean).flatten(1)
        whole = white.isfinite().all(1)
        found = torch.full((len(white), self._num_kept), torch.nan).double()
        key = action.numpy().tobytes()
        if key not in self._known and bool(whole.any()):
            self._known[key] = self._directions(white[whole][: self._num_rows])
        if key not in self._known:
            return found
        own = self._known[key]
        off = white[whole] - own.center
        short = off @ own.rows.T
        rest = off.square().sum(1) - short.square().sum(1)
        self.left_out = max(self.left_out, 0.5 * float(rest.mean().clamp_min(0.0)))
        found[whole] = torch.nn.functional.pad(
            short, (0, self._num_kept - short.shape[1])
        )
        return found

    def _directions(self, white: Tensor) -> _Directions:
        center = white.mean(0)
        rows = torch.linalg.svd(white - center, full_matrices=False)[2]
        return _Directions(center, rows[: self._num_kept])

    def note(self, num_numbers: int) -> str:
        """Return a note on what is compared in place of how many numbers."""
        return (
            f"{self._num_kept} linear summaries stand for the {num_numbers} numbers of "
            f"an outcome, and leave out about {self.left_out:.2g} nats"
        )
