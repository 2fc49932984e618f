"""Gaussian mixture whose parameters a network makes of the condition."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor, nn
from typing_extensions import override

from sbi_active.arrays import finite
from sbi_active.inference.networks.baseline import Frames, local
from sbi_active.inference.networks.conditioning import Conditioning

ACTIVATIONS = {"silu": nn.SiLU, "relu": nn.ReLU}


def log_prob_of_batch(
    network: ConditionalDensityEstimator,
    density: Callable[[Tensor, Tensor], Tensor],
    input: Tensor,
    condition: Tensor,
) -> Tensor:
    """Return log densities, shape (sample_dim, batch_dim).

    Args:
        network: Knows the shapes of an input and of a condition.
        density: Log density of inputs (sample_dim, batch_dim, d), given conditions
            (batch_dim, condition_dim).
        input: Inputs, shape (sample_dim, batch_dim, d) or (batch_dim, d).
        condition: Conditions, shape (batch_dim, condition_dim), or with the sample_dim
            too.
    """
    network._check_condition_shape(condition)
    network._check_input_shape(input)
    rows = input[None] if input.ndim == 2 else input
    if condition.ndim == 2:
        return density(rows, condition)
    shape = condition.shape[:2]
    pairs = rows.expand(*shape, -1).reshape(1, -1, rows.shape[-1])
    return density(pairs, condition.flatten(0, 1)).reshape(shape)


class MixtureDensityNetwork(ConditionalDensityEstimator):
    r"""Gaussian mixture whose parameters are functions of the condition.

    .. math::
        q(\theta | c) = \sum_k \pi_k(c)\, \mathcal{N}(u; \mu_k(c), (R_k^\top R_k)^{-1})
        \, |\mathrm{d}u / \mathrm{d}\theta|, \qquad u = (\theta - m) / s,

    with R_k upper triangular, its diagonal the exponential of an output; of more than
    12 parameters what is above the diagonal does not depend on c. The condition
    is standardized column by column. Where training rows hold NaN (outcomes without a
    measurement), those numbers are set to zero and a 0/1 mask is appended, so that
    "there was no measurement" is itself something to condition on.

    Where the action's place in the condition is known, a
    :class:`.Conditioning` takes the place of both
    standardizations, as the settings say. Component k then lives in the coordinates
    :math:`v = U_j(c)\,(u - m_j(c))` of one of its frames,

    .. math::
        q(\theta | c) = \Big|\frac{\mathrm{d}u}{\mathrm{d}\theta}\Big| \sum_k \pi_k(c)\,
        |U_{j(k)}(c)|\, \mathcal{N}(v_{j(k)}; \mu_k(c), (R_k^\top R_k)^{-1}).

    Args:
        theta: Training parameters, shape (n, theta_dim).
        condition: Training conditions, shape (n, condition_dim).
        action_dim: Numbers of the action at the end of a condition; None leaves them
            unknown, and scaling, whitening and baseline without effect.
        settings: Settings, a :class:`.MixtureDensity`. With an embedding network the
            condition is scaled over all rows, without a baseline.
        global_logit: Logit of a component of the global frame at the start, where
            others are of local frames: a twentieth of the weight of each.
        few: Number of parameters beyond which correlations of a component are the same
            for all conditions, in its frame: their number grows with the square, and
            thousands of rows do not tell how each depends on the condition.
    """

    def __init__(
        self,
        theta: Tensor,
        condition: Tensor,
        action_dim: int | None,
        settings: Any,
        *,
        global_logit: float = -3.0,
        few: int = 12,
    ) -> None:
        dim, num = theta.shape[1], settings.num_components
        missing = ~finite(condition)
        ever_missing = missing.any(0)
        # Columns that go missing together need one mask between them.
        lost = ever_missing.nonzero()[:, 0]
        largest_gap = int(missing[:, lost].sum(1).max())
        masks, columns = missing[:, lost].unique(dim=1, return_inverse=True)
        first = [int((columns == k).nonzero()[0]) for k in range(masks.shape[1])]
        masked = lost[first].tolist()

        details = settings.details
        how: Any = details.scaling, details.whiten, details.baseline
        if settings.embedding_net is not None:
            how = "global", details.whiten, "none"
        embedding = settings.embedding_net or nn.Identity()
        conditioning = None
        if action_dim is not None and how != ("global", False, "none"):
            most = 200 if settings.embedding_net is None else math.inf
            conditioning = Conditioning(
                *(theta, condition, action_dim, *how), most_numbers=most
            )
        with torch.no_grad():
            if conditioning is None:
                seen = torch.zeros(2, condition.shape[1])
            else:
                seen = conditioning(condition[:2])[0].float()
            width = embedding(seen).shape[1] + len(masked)
        layers: list[nn.Module] = []
        for hidden in settings.hidden_features:
            layers += [nn.Linear(width, hidden), ACTIVATIONS[details.activation]()]
            width = hidden
        num_upper = dim * dim if dim <= few else 0
        last = nn.Linear(width, num * (1 + 2 * dim + num_upper))
        super().__init__(
            nn.Sequential(*layers, last), theta.shape[1:], condition.shape[1:]
        )
        self._embedding: nn.Module = embedding
        self._num_components, self._dim = num, dim
        self._masked_columns = masked
        self._ever_missing, self._largest_gap = ever_missing.cpu(), largest_gap
        self._sections = [num, num * dim, num * dim, num * num_upper]
        if not num_upper:
            self._upper = nn.Parameter(torch.zeros(num, dim, dim))
        with torch.no_grad():  # start near a broad mixture that ignores the condition
            last.weight.mul_(0.1)
            last.bias.zero_()
            last.bias[num : num + num * dim].normal_(0.0, 0.5)

        self.conditioning = conditioning
        self._frame_of = _frame_of_components(num, self.num_frames)
        if self.num_frames > 1 and num > 1:
            with torch.no_grad():
                last.bias[num - 1] = global_logit
        some = slice(0 if conditioning is not None else None)  # else not used
        mean, scale = _location_and_scale(condition[some], ~missing[some])
        self.condition_mean = nn.Buffer(mean)
        self.condition_scale = nn.Buffer(scale)
        mean, scale = _location_and_scale(theta, torch.ones_like(theta).bool())
        self.theta_mean = nn.Buffer(mean)
        self.theta_scale = nn.Buffer(scale)
        self.strict_upper = nn.Buffer(torch.ones(dim, dim).triu(1))

    @property
    @override
    def embedding_net(self) -> nn.Module:
        return self._embedding

    def knows(self, condition: Tensor) -> bool:
        """Return whether training rows lacked what conditions (n, c) lack.

        Each number that is missing must have been so in some row, and as many as are
        missing must have been so at once.
        """
        missing = ~condition.isfinite().cpu()
        unheard = missing & ~self._ever_missing
        gap = int(missing.sum(1).max())
        return not bool(unheard.any()) and gap <= self._largest_gap

    @property
    def num_frames(self) -> int:
        """Frames of a row that components live in."""
        return 1 if self.conditioning is None else self.conditioning.num_frames

    @property
    def can_prepare(self) -> bool:
        """Whether rows can go through the conditioning once, before training."""
        return self.conditioning is not None and isinstance(
            self._embedding, nn.Identity
        )

    def loss(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return -log q, shape (n,), for rows (n, theta_dim) and (n, condition_dim)."""
        return -self._log_density(input, condition)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return log q(input | condition), shape (sample_dim, batch_dim).

        Args:
            input: Parameters, shape (sample_dim, batch_dim, theta_dim) or (batch_dim,
                theta_dim).
            condition: Conditions, shape (batch_dim, condition_dim), or with the
                sample_dim too.
            kwargs: Arguments that are not used.
        """
        return log_prob_of_batch(self, self._log_density, input, condition)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: object
    ) -> Tensor:
        """Return draws, shape (*sample_shape, batch_dim, theta_dim)."""
        self._check_condition_shape(condition)
        shape = torch.Size(sample_shape)
        seen, frames = self._see(condition)
        logits, mean, log_diagonal, upper = self._mixture(seen)
        batch = len(condition)
        component = torch.distributions.Categorical(logits=logits).sample(shape)
        row = torch.arange(batch, device=logits.device).expand(component.shape)
        factor = upper + torch.diag_embed(log_diagonal.exp())
        noise = torch.randn(*component.shape, self._dim, 1, device=logits.device)
        step = _solved(factor, row, component, noise.to(logits.dtype)[..., 0])
        v = mean[row, component] + step
        if self.conditioning is None or frames is None:
            return v * self.theta_scale + self.theta_mean
        frame = torch.tensor(self._frame_of, device=logits.device)[component]
        u = frames.mean[row, frame] + _solved(frames.factor, row, frame, v.double())
        return self.conditioning.whiten.inverse(u).to(logits.dtype)

    def prepare(
        self, theta: Tensor, condition: Tensor, *, most_factors: int = 10_000_000
    ) -> tuple[Tensor, Tensor]:
        """Return rows for :meth:`prepared_loss`: all that no weight changes."""
        most = max(1, most_factors // (self.num_frames * self._dim**2))
        prepared, inputs = [], []
        with torch.no_grad():
            for part, own in zip(theta.split(most), condition.split(most), strict=True):
                seen, frames = self._see(own)
                assert frames is not None
                v, log_det = self._local(part, frames)
                v, log_det = v[:, self._frame_of], log_det[:, self._frame_of]
                prepared.append(torch.cat([v.flatten(1), log_det], 1))
                inputs.append(seen)
        return torch.cat(prepared), torch.cat(inputs)

    def prepared_loss(self, prepared: Tensor, seen: Tensor) -> Tensor:
        """Return -log q, shape (n,), for rows that went through the conditioning once.

        Training visits a row several times, and only the layers change between visits.
        """
        v, log_det = prepared.tensor_split([-self._num_components], 1)
        v = v.reshape(len(v), self._num_components, -1)
        return -self._log_local_density(v, log_det, seen)

    def _log_density(self, theta: Tensor, condition: Tensor) -> Tensor:
        seen, frames = self._see(condition)
        if frames is not None:
            v, log_det = self._local(theta, frames)
            v, log_det = v[..., self._frame_of, :], log_det[:, self._frame_of]
            return self._log_local_density(v, log_det, seen)
        u = ((theta - self.theta_mean) / self.theta_scale)[..., None, :]
        constant = self._log_normal_constant + self.theta_scale.log().sum()
        return self._log_mixture(u, seen, 0.0) - constant

    def _local(self, theta: Tensor, frames: Frames) -> tuple[Tensor, Tensor]:
        """Return v (..., n, J, d) and log |dv / dtheta| (n, J)."""
        assert self.conditioning is not None
        v = local(self.conditioning.whiten(theta), frames)
        log_det = frames.log_det + self.conditioning.whiten.log_det
        dtype = self.strict_upper.dtype
        return v.to(dtype), log_det.to(dtype)

    def _log_local_density(self, v: Tensor, log_det: Tensor, seen: Tensor) -> Tensor:
        """Return log q of each component's own v (..., n, K, d), shape (..., n)."""
        return self._log_mixture(v, seen, log_det) - self._log_normal_constant

    @property
    def _log_normal_constant(self) -> float:
        return 0.5 * self._dim * math.log(2 * math.pi)

    def _log_mixture(self, v: Tensor, seen: Tensor, log_det: Tensor | float) -> Tensor:
        """Return the log density of v, shape (..., n, K or 1, d), up to a constant."""
        logits, mean, log_diagonal, upper = self._mixture(seen)
        error = v - mean
        if upper.ndim == 4:  # by row; a product and a sum are faster
            above = (upper * error[..., None, :]).sum(-1)
        else:
            above = torch.einsum("kij,...nkj->...nki", upper, error)
        z = log_diagonal.exp() * error + above
        component = log_diagonal.sum(-1) - 0.5 * z.square().sum(-1)
        return (logits + component + log_det).logsumexp(-1) - logits.logsumexp(-1)

    def _see(self, condition: Tensor) -> tuple[Tensor, Frames | None]:
        """Return the layers' input for a condition, and the frames of its row."""
        if self.conditioning is None:
            z, frames = (condition - self.condition_mean) / self.condition_scale, None
        else:
            z, frames = self.conditioning(condition)
            z = z.to(self.strict_upper.dtype)
        if not self._masked_columns:
            return self._embedding(z), frames
        mask = (~condition[:, self._masked_columns].isfinite()).to(z.dtype)
        z = self._embedding(z.nan_to_num(0.0, 0.0, 0.0))
        return torch.cat([z, mask], -1), frames

    def _mixture(
        self, seen: Tensor, *, log_precision: tuple[float, float] = (-10.0, 16.0)
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return logits, means, log-diagonals and factors above them, (n, K, ...).

        The factors are of shape (K, d, d) where they do not depend on the condition.
        Bounds of the log-precision of a standardized parameter are wide enough for
        seven decimal digits, where float32 ends.
        """
        logits, mean, log_diagonal, upper = self.net(seen).split(self._sections, -1)
        shape = (len(seen), self._num_components, self._dim)
        upper = upper.reshape(*shape, self._dim) if upper.shape[1] else self._upper
        return (
            logits,
            mean.reshape(shape),
            log_diagonal.reshape(shape).clamp(*log_precision),
            upper * self.strict_upper,
        )


def _frame_of_components(num_components: int, num_frames: int) -> list[int]:
    """The local frames take turns; the last component has the global frame."""
    num_local = max(num_frames - 1, 1)
    frames = [k % num_local for k in range(num_components)]
    if num_components > 1:
        frames[-1] = num_frames - 1
    return frames


def _location_and_scale(rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of the valid numbers of each column."""
    count = valid.sum(0).clamp_min(1)
    values = torch.where(valid, rows, 0.0).double()
    mean = values.sum(0) / count
    variance = (torch.where(valid, values - mean, 0.0) ** 2).sum(0) / count
    scale = variance.sqrt()
    # A constant column carries nothing: dividing by one keeps it at zero.
    scale = torch.where(scale > 1e-12 * (1.0 + mean.abs()), scale, 1.0)
    return mean.float(), scale.float()


def _solved(
    factor: Tensor,
    row: Tensor,
    which: Tensor,
    right: Tensor,
    *,
    few: int = 12,
    most_factors: int = 10_000_000,
) -> Tensor:
    """Return solutions (..., d) of upper factors [row, which] for right sides.

    Beyond a few dimensions a factor serves many draws; otherwise, as in ``prepare``, so
    many numbers of the factors are in memory at once, 40 MB.
    """
    dim = right.shape[-1]
    if len(factor) == 1 and dim > few:
        found = torch.empty_like(right)
        for k, own in enumerate(factor[0]):
            at = which == k
            found[at] = torch.linalg.solve_triangular(own, right[at].mT, upper=True).mT
        return found
    most = max(1, most_factors // (row[0].numel() * dim**2))
    parts = [part.split(most) for part in (row, which, right[..., None])]
    solve = torch.linalg.solve_triangular
    steps = [solve(factor[r, k], e, upper=True) for r, k, e in zip(*parts, strict=True)]
    return torch.cat(steps)[..., 0]
