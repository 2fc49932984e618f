"""A posterior given the number of a row, as sbi's diagnostics take it."""

from __future__ import annotations

from typing import Any

import torch
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from torch import Tensor

from sbi_active.inference.models.posterior import at_conditions
from sbi_active.support import within_support

TRIES = (1, 8, 40)  # times as many draws as are needed, for the rows that still lack


class RowPosterior(DirectPosterior):
    """Draws within the prior's support, at a bounded cost.

    Rejection waits without end for a row whose network lies beside the support, which
    is what a check meets. Such a row keeps its draws outside, where they are wrong.
    """

    @classmethod
    def of(
        cls, direct: DirectPosterior, condition: Tensor
    ) -> tuple[RowPosterior, Tensor]:
        """Return the posterior over rows of packed conditions, and their numbers."""
        made, index = at_conditions(direct, condition)
        made.__class__ = cls
        assert isinstance(made, cls)
        return made, index

    def sample_batched(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, sample_shape: Any, x: Tensor, **_: Any
    ) -> Tensor:
        """Return draws given each row, shape (m, n, theta_dim)."""
        num = torch.Size(sample_shape).numel()
        network: Any = self.posterior_estimator
        kept: Tensor = torch.empty(0)
        left = torch.arange(len(x))
        for times in TRIES:
            drawn = network.sample(torch.Size([times * num]), x[left])
            inside = within_support(self.prior, drawn.flatten(0, 1))
            inside = inside.reshape(drawn.shape[:2])
            first = (~inside).to(torch.int8).argsort(dim=0, stable=True)[:num]
            best = drawn.gather(0, first[..., None].expand(-1, -1, drawn.shape[-1]))
            kept = best.clone() if times == TRIES[0] else kept
            kept[:, left] = best
            left = left[inside.sum(0) < num]
            if len(left) == 0:
                break
        return kept
