"""Transforms of a network's parameters and conditions, and their inverses."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from sbi_active.arrays import finite
from sbi_active.inference.networks.baseline import Baseline, Frames, local
from sbi_active.inference.networks.response import Response, held_out, log_normal


def can_regress(
    valid: Tensor, num_outcomes: int, *, fewest: int = 40, most: int = 32
) -> bool:
    """Return whether a regression of the outcome is tried.

    Args:
        valid: Mask of the rows with a measurement, shape (n,).
        num_outcomes: Number of numbers in an outcome.
        fewest: Number of these rows at least, of which a fifth is held out.
        most: Number of numbers at most: each has coefficients of its own.
    """
    return int(valid.sum()) >= fewest and num_outcomes <= most


class Whitening(nn.Module):
    r"""Parameters of no mean and unit covariance, :math:`u = L^{-1} (\theta - m)`.

    Args:
        theta: Parameters that give the moments, shape (n, d).
        full: Whether correlations count, or each parameter is only scaled.
    """

    def __init__(self, theta: Tensor, *, full: bool) -> None:
        super().__init__()
        theta = theta.double()
        mean, scale = moments(theta)
        factor = scale.diag()
        if full and len(theta) > len(scale):
            z = (theta - mean) / scale
            correlation = z.mT @ z / len(z)
            # A constant parameter keeps the scale one.
            correlation = correlation + torch.diag((correlation.diagonal() < 0.5).to(z))
            tiny = 1e-12 * torch.eye(len(scale), dtype=z.dtype)
            factor = scale[:, None] * torch.linalg.cholesky(correlation + tiny)
        self.mean, self.factor = nn.Buffer(mean), nn.Buffer(factor)

    def forward(self, theta: Tensor) -> Tensor:
        """Return u, (..., d) -> (..., d), in float64."""
        step = (theta.double() - self.mean)[..., None]
        return torch.linalg.solve_triangular(self.factor, step, upper=False)[..., 0]

    def inverse(self, u: Tensor) -> Tensor:
        """Return theta, (..., d) -> (..., d)."""
        return (self.factor @ u[..., None])[..., 0] + self.mean

    @property
    def log_det(self) -> Tensor:
        r""":math:`\log |\mathrm d u / \mathrm d \theta|`."""
        return -self.factor.diagonal().log().sum()


class Directions(nn.Module):
    r"""Linear summaries of outcomes: what parameters move, and what moves most.

    Half of the directions at most are the leading right singular vectors of
    :math:`F^\top X`, with X the standardized outcomes and F the parameters, their
    products, and their products with the action; the others are principal directions
    of X beside them.

    Args:
        u: Whitened parameters, shape (n, d).
        x: Outcomes, shape (n, m), all finite.
        action: Actions, shape (n, action_dim).
        num: Number of directions, fewer where rows or numbers are.
        block: Number of rows in double precision at once, and of those behind principal
            directions.
    """

    def __init__(
        self, u: Tensor, x: Tensor, action: Tensor, *, num: int, block: int = 512
    ) -> None:
        super().__init__()
        # NumPy sums in double precision without a copy in it.
        mean = torch.from_numpy(x.cpu().numpy().mean(0, dtype=np.float64)).to(x.device)
        scale = x.std(0).double()
        scale = torch.where(scale > 1e-12 * (1 + mean.abs()), scale, 1.0)
        self.mean = nn.Buffer(mean)
        self.scale = nn.Buffer(scale)
        features = _products(u, action)
        moved = x.new_zeros(features.shape[1], x.shape[1]).double()
        for row in range(0, len(x), block):
            part = slice(row, row + block)
            moved += features[part].T @ self._standardized(x[part])
        rows = torch.linalg.svd(moved, full_matrices=False)[2][: num // 2]
        rest = self._standardized(x[:block])
        rest = rest - (rest @ rows.T) @ rows
        largest = torch.linalg.svd(rest, full_matrices=False)[2][: num - len(rows)]
        rows = torch.linalg.qr(torch.cat([rows, largest]).T).Q.T
        self.rows = nn.Buffer(rows.contiguous())

    def forward(self, x: Tensor, *, block: int = 512) -> Tensor:
        """Return summaries, shape (n, k).

        A number that is missing counts as the mean; an outcome without any is NaN.
        """
        parts = [self._summaries(part) for part in x.split(block)]
        return torch.cat(parts)

    def _summaries(self, x: Tensor) -> Tensor:
        seen = x.isfinite()
        known = torch.where(seen, self._standardized(x), 0.0) @ self.rows.T
        return torch.where(seen.any(1, keepdim=True), known, torch.nan)

    def _standardized(self, x: Tensor) -> Tensor:
        return (x.double() - self.mean) / self.scale


def _products(u: Tensor, action: Tensor, *, most: int = 256) -> Tensor:
    """Return standardized products of parameters and actions, shape (n, f)."""
    a = (action.double() - action.mean(0)) / action.std(0).clamp_min(1e-30)
    i, j = torch.triu_indices(u.shape[1], u.shape[1])
    parts = [u, *(u * a[:, [k]] for k in range(a.shape[1]))]
    parts += [u * a[:, [k]].square() for k in range(a.shape[1])]
    features = torch.cat([*parts, u[:, i] * u[:, j]], 1)[:, :most]
    features = features - features.mean(0)
    return features / features.std(0).clamp_min(1e-30)


class Conditioning(nn.Module):
    r"""Standardized outcomes and whitened, locally standardized parameters.

    .. math::
        \tilde x = \frac{x - \mu(\xi)}{\sigma(\xi)}, \qquad
        u = W (\theta - \bar\theta), \quad W^\top W = \mathrm{Cov}(\theta)^{-1}, \qquad
        v_j = U_j(x, \xi)\, (u - m_j(x, \xi)),

    where the frames (m, U) come from a :class:`.Baseline`
    and a last one is the whitened parameters themselves (m = 0, U = I), so that no row
    is lost where the baseline errs. All of it is in float64: x may reach 15,000 with
    noise 1, and theta be known to 1e-4 of its range.

    With a baseline the network sees m(x, action), in which noise is shrunk as Bayes'
    rule does, and x standardized over all rows; without, :math:`\tilde x`. Both
    :math:`\tilde x` and m were overfitted: where an action tells little, the first is
    noise of scale one.

    Args:
        theta: Parameters, shape (n, theta_dim).
        condition: Packed (x, action), shape (n, x_dim + action_dim); NaN in x where
            there was no measurement.
        action_dim: Numbers in an action.
        whiten: Whether theta is whitened by its full covariance or only scaled.
        adapts: Whether a baseline's frames are used, the linear or the curved one or
            none by Gaussian log scores on held-out rows; otherwise all is scaled over
            all rows.
        most_numbers: Number of an outcome's numbers beyond which
            :class:`.Directions` stand for them. Half of it summarizes what a network
            learns as well in ten times the time.
        num_directions: Number of these; a baseline takes 32 at most.
        margin: Nats by which a curved baseline must beat the simpler one: its frames
            and what the network sees of them are more to overfit.

    Attributes:
        baseline: The baseline in use; None if there is none.
    """

    def __init__(
        self,
        theta: Tensor,
        condition: Tensor,
        action_dim: int,
        *,
        whiten: bool,
        adapts: bool,
        most_numbers: int = 200,
        num_directions: int = 32,
        margin: float = 0.25,
    ) -> None:
        super().__init__()
        self.x_dim = condition.shape[1] - action_dim
        self.whiten = Whitening(theta, full=whiten)
        x, action = condition.split([self.x_dim, action_dim], 1)
        valid = finite(x).all(1)
        self.directions: Directions | None = None
        if adapts and self.x_dim > most_numbers and can_regress(valid, num_directions):
            some = slice(None) if bool(valid.all()) else valid  # without a copy
            own = self.whiten(theta[some]), x[some], action[some]
            self.directions = Directions(*own, num=num_directions)
        x, action = self._summarized(x), action.double()
        self.action_mean, self.action_scale = map(nn.Buffer, moments(action))
        self.y_mean, self.y_scale = map(nn.Buffer, moments(x))
        self.baseline: Baseline | None = None
        self.x_scaling: Response | None = None
        if adapts and can_regress(valid, x.shape[1]):
            y = (x[valid] - self.y_mean) / self.y_scale
            self._choose(self.whiten(theta[valid]), y, action[valid], margin)

    def _summarized(self, x: Tensor) -> Tensor:
        """Return outcomes as they are, or a few directions of them, (n, k)."""
        return x.double() if self.directions is None else self.directions(x)

    def _choose(self, u: Tensor, y: Tensor, action: Tensor, margin: float) -> None:
        """Take the baseline that predicts held-out rows best, if one does better."""
        test = held_out(len(u))
        best = float(log_normal(u[test]).mean())
        kinds: list[tuple[Literal["linear", "curved"], float]]
        kinds = [("linear", 0.0), ("curved", margin)]
        for kind, least in kinds:
            if self.baseline is not None and not self.baseline.bends(u, y, action):
                continue
            candidate = Baseline(u, y, action, kind=kind)
            frames = candidate(y[test], action[test]).with_global()
            score = float(_log_mixture(u[test], frames).mean())
            if score > best + least:
                best, self.baseline = score, candidate
        if self.baseline is None:
            self.x_scaling = Response.marginal(y, action)

    @property
    def num_frames(self) -> int:
        """Local frames of each row, and the global one."""
        if self.baseline is None:
            return 1
        return {"linear": 2, "curved": 3}[self.baseline.kind]

    def forward(
        self, condition: Tensor, *, largest: float = 20.0
    ) -> tuple[Tensor, Frames]:
        """Return the network's inputs, (n, x_dim + action_dim + ...), and the frames.

        Numbers of x that are missing are zero; a row with any has trivial frames.
        """
        x, action = condition.split([self.x_dim, condition.shape[1] - self.x_dim], 1)
        lost = ~finite(x).all(1)[:, None]
        x, action = self._summarized(x), action.double()
        missing = ~x.isfinite()
        # Missing numbers are replaced before any arithmetic, lest gradients be NaN.
        scaled = y = (torch.where(missing, self.y_mean, x) - self.y_mean) / self.y_scale
        if self.x_scaling is not None:
            location, scale = self.x_scaling.location_and_scale(action)
            scaled = torch.where(missing, 0.0, (y - location) / scale)
        seen = [scaled, (action - self.action_mean) / self.action_scale]
        trivial = Frames.trivial(y, len(self.whiten.mean))
        if self.baseline is None:
            return torch.cat(seen, 1), trivial
        frames = self.baseline(y, action)
        frames = Frames(
            torch.where(lost[..., None], 0.0, frames.mean),
            torch.where(lost[..., None, None], trivial.factor, frames.factor),
            torch.where(lost, 0.0, frames.misfit),
        )
        seen.append(frames.mean.flatten(1))
        if frames.misfit.shape[1] > 1:
            excess = frames.misfit - frames.misfit.min(1, keepdim=True).values
            seen.append(torch.tanh(excess / largest))
        return torch.cat(seen, 1), frames.with_global()


def _log_mixture(u: Tensor, frames: Frames) -> Tensor:
    """Log density of the local frames, equally weighted, with 1 % of the global one."""
    log_density = frames.log_det + log_normal(local(u, frames))
    weight = torch.full((log_density.shape[1],), 0.99 / (log_density.shape[1] - 1))
    weight[-1] = 0.01
    return (log_density + weight.to(u).log()).logsumexp(-1)


def moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of the finite numbers of each column, float64 (d,).

    A column that is constant, or has no finite number, carries nothing: divided by one
    it keeps at zero.
    """
    known = finite(rows)
    count, rows = known.sum(0).clamp_min(1), rows.double()
    mean = torch.where(known, rows, 0.0).sum(0) / count
    scale = (torch.where(known, rows - mean, 0.0).square().sum(0) / count).sqrt()
    return mean, torch.where(scale > 1e-12 * (1.0 + mean.abs()), scale, 1.0)
