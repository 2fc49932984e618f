"""Gaussian mixture whose parameters a network makes of the condition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor, nn
from typing_extensions import override

from sbi_active.arrays import finite
from sbi_active.inference.networks.baseline import Frames, local
from sbi_active.inference.networks.conditioning import Conditioning
from sbi_active.inference.networks.response import log_normal

#: What a condition may have for NaN, which sbi's posteriors refuse: no measurement.
MISSING = torch.finfo(torch.float32).min
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


def layers(
    width: int, hidden: Sequence[int], num_outputs: int, activation: type[nn.Module]
) -> nn.Sequential:
    """Return linear layers with activations between; outputs are small at first."""
    parts: list[nn.Module] = []
    for size in hidden:
        parts += [nn.Linear(width, size), activation()]
        width = size
    last = nn.Linear(width, num_outputs)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*parts, last)


class MixtureDensityNetwork(ConditionalDensityEstimator):
    r"""Gaussian mixture whose parameters are functions of the condition.

    Component k lives in the coordinates :math:`v = U_j(c)\,(u - m_j(c))` of one of the
    frames of a :class:`.Conditioning`, with u the whitened parameters,

    .. math::
        q(\theta | c) = \Big|\frac{\mathrm{d}u}{\mathrm{d}\theta}\Big| \sum_k \pi_k(c)\,
        |U_{j(k)}(c)|\, \mathcal{N}(v_{j(k)}; \mu_k(c), (R_k^\top R_k)^{-1}),

    with R_k upper triangular, its diagonal the exponential of an output; of more than
    12 parameters what is above the diagonal does not depend on c. Where training rows
    hold NaN (outcomes without a measurement), those numbers are set to zero and a 0/1
    mask is appended, so that "there was no measurement" is itself something to
    condition on.

    Args:
        theta: Training parameters, shape (n, theta_dim).
        condition: Training conditions, shape (n, condition_dim).
        action_dim: Numbers of the action at the end of a condition; None leaves them
            unknown, and all numbers are scaled over all rows.
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
        masks, columns = missing[:, lost].unique(dim=1, return_inverse=True)
        first = [int((columns == k).nonzero()[0]) for k in range(masks.shape[1])]
        masked = lost[first].tolist()

        adapts = action_dim is not None and settings.details.baseline == "best"
        own, embedding = settings.embedding_net is None, settings.embedding_net
        conditioning = Conditioning(
            *(theta, condition, action_dim or 0), whiten=adapts, adapts=adapts and own
        )
        embedding = embedding or nn.Identity()
        with torch.no_grad():
            seen = conditioning(condition[:2])[0].float()
            width = embedding(seen).shape[1] + len(masked)
        num_upper = dim * dim if dim <= few else 0
        outputs = num * (1 + 2 * dim + num_upper)
        activation = ACTIVATIONS[settings.details.activation]
        net = layers(width, settings.hidden_features, outputs, activation)
        super().__init__(net, theta.shape[1:], condition.shape[1:])
        self._embedding: nn.Module = embedding
        self.conditioning = conditioning
        self._num_components, self._dim = num, dim
        self._masked_columns, self._ever_missing = masked, ever_missing.cpu()
        # NumPy sums a mask without a copy of eight times its size.
        self._largest_gap = int(missing.cpu().numpy().sum(1).max())
        self._sections = [num, num * dim, num * dim, num * num_upper]
        # The local frames take turns; the last component has the global frame.
        num_frames = conditioning.num_frames
        self._frame_of = [k % max(num_frames - 1, 1) for k in range(num)]
        bias = net[-1].bias
        assert isinstance(bias, Tensor)
        with torch.no_grad():  # start near a broad mixture that ignores the condition
            bias[num : num + num * dim].normal_(0.0, 0.5)
            if num > 1:
                self._frame_of[-1] = num_frames - 1
                bias[num - 1] = global_logit if num_frames > 1 else 0.0
        if not num_upper:
            self._upper = nn.Parameter(torch.zeros(num, dim, dim))
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
        component = torch.distributions.Categorical(logits=logits).sample(shape)
        row = torch.arange(len(condition), device=logits.device)
        row = row.expand(component.shape)
        factor = upper + torch.diag_embed(log_diagonal.exp())
        noise = torch.randn(*component.shape, self._dim, 1, device=logits.device)
        step = _solved(factor, row, component, noise.to(logits.dtype)[..., 0])
        v = (mean[row, component] + step).double()
        frame = torch.tensor(self._frame_of, device=logits.device)[component]
        u = frames.mean[row, frame] + _solved(frames.factor, row, frame, v)
        return self.conditioning.whiten.inverse(u).to(logits.dtype)

    def prepare(
        self, theta: Tensor, condition: Tensor, *, most_factors: int = 10_000_000
    ) -> tuple[Tensor, Tensor]:
        """Return rows for :meth:`prepared_loss`: all that no weight changes."""
        most = max(1, most_factors // (self.conditioning.num_frames * self._dim**2))
        prepared, inputs = [], []
        with torch.no_grad():
            for part, own in zip(theta.split(most), condition.split(most), strict=True):
                seen, frames = self._see(own)
                v, log_det = self._local(part, frames)
                prepared.append(torch.cat([v.flatten(1), log_det], 1))
                inputs.append(seen)
        return torch.cat(prepared), torch.cat(inputs)

    def prepared_loss(self, prepared: Tensor, seen: Tensor) -> Tensor:
        """Return -log q, shape (n,), for rows that went through the conditioning once.

        Training visits a row several times, and only the layers change between visits.
        """
        v, log_det = prepared.tensor_split([-self._num_components], 1)
        v = v.reshape(len(v), self._num_components, -1)
        return -self._log_mixture(v, log_det, seen)

    def _log_density(self, theta: Tensor, condition: Tensor) -> Tensor:
        seen, frames = self._see(condition)
        return self._log_mixture(*self._local(theta, frames), seen)

    def _local(self, theta: Tensor, frames: Frames) -> tuple[Tensor, Tensor]:
        """Return each component's v (..., n, K, d) and log |dv / dtheta| (n, K)."""
        whiten, dtype = self.conditioning.whiten, self.strict_upper.dtype
        v = local(whiten(theta), frames)[..., self._frame_of, :]
        log_det = frames.log_det[:, self._frame_of] + whiten.log_det
        return v.to(dtype), log_det.to(dtype)

    def _log_mixture(self, v: Tensor, log_det: Tensor, seen: Tensor) -> Tensor:
        """Return log q of each component's own v (..., n, K, d), shape (..., n)."""
        logits, mean, log_diagonal, upper = self._mixture(seen)
        error = v - mean
        if upper.ndim == 4:  # by row; a product and a sum are faster
            above = (upper * error[..., None, :]).sum(-1)
        else:
            above = torch.einsum("kij,...nkj->...nki", upper, error)
        z = log_diagonal.exp() * error + above
        component = logits + log_diagonal.sum(-1) + log_normal(z) + log_det
        return component.logsumexp(-1) - logits.logsumexp(-1)

    def _see(self, condition: Tensor) -> tuple[Tensor, Frames]:
        """Return what the layers see of a condition, and the frames of its row."""
        condition = condition.where(condition != MISSING, torch.nan)
        z, frames = self.conditioning(condition)
        mask = ~condition[:, self._masked_columns].isfinite()
        z = torch.cat([z, mask.to(z)], 1).to(self.strict_upper.dtype)
        return z, frames

    def _mixture(
        self, seen: Tensor, *, log_precision: tuple[float, float] = (-10.0, 16.0)
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return logits, means, log-diagonals and factors above them, (n, K, ...).

        The factors are of shape (K, d, d) where they do not depend on the condition.
        Bounds of the log-precision of a standardized parameter are wide enough for
        seven decimal digits, where float32 ends.
        """
        z, mask = seen.tensor_split([seen.shape[1] - len(self._masked_columns)], 1)
        outputs = self.net(torch.cat([self._embedding(z), mask], 1))
        logits, mean, log_diagonal, upper = outputs.split(self._sections, -1)
        shape = (len(seen), self._num_components, self._dim)
        upper = upper.reshape(*shape, self._dim) if upper.shape[1] else self._upper
        return (
            logits,
            mean.reshape(shape),
            log_diagonal.reshape(shape).clamp(*log_precision),
            upper * self.strict_upper,
        )


def _solved(
    factor: Tensor,
    row: Tensor,
    which: Tensor,
    right: Tensor,
    *,
    most_factors: int = 10_000_000,
) -> Tensor:
    """Return solutions (..., d) of upper factors [row, which] for right sides.

    As in ``prepare``, so many numbers of the factors are in memory at once, 40 MB.
    """
    most = max(1, most_factors // (row[0].numel() * right.shape[-1] ** 2))
    parts = [part.split(most) for part in (row, which, right[..., None])]
    solve = torch.linalg.solve_triangular
    steps = [solve(factor[r, k], e, upper=True) for r, k, e in zip(*parts, strict=True)]
    return torch.cat(steps)[..., 0]
