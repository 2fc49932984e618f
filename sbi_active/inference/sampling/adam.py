"""Adam on the kernels of torch."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Adam, with decoupled weight decay.

    It is ``torch.optim.Adam`` to the last bit, or ``AdamW``. Those import torch's
    compiler at their first step, which takes three CPU seconds of a process.

    Args:
        parameters: Parameters that are changed in place.
        rate: Learning rate.
        decay: Weight decay, as a share of the learning rate.
        fused: Whether one kernel updates all of a parameter's moments.

    Attributes:
        initial_rate: Learning rate that it began with.
        rate: Learning rate of the next step.

    References:
        Kingma & Ba, ICLR 2015; Loshchilov & Hutter, ICLR 2019.
    """

    def __init__(
        self,
        parameters: Iterable[Tensor],
        *,
        rate: float,
        decay: float = 0.0,
        fused: bool = False,
    ) -> None:
        self.parameters = [*parameters]
        self.initial_rate = self.rate = rate
        self.decay, self.fused = decay, fused
        self._mean = [torch.zeros_like(p) for p in self.parameters]
        self._square = [torch.zeros_like(p) for p in self.parameters]
        # Counts of one kernel are where it runs, and in single precision.
        self._steps = [
            torch.zeros((), dtype=torch.float32, device=p.device if fused else "cpu")
            for p in self.parameters
        ]

    def forget_gradients(self) -> None:
        """Leave no gradient behind."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change the parameters by their gradients."""
        moved = [k for k, p in enumerate(self.parameters) if p.grad is not None]
        if self.decay:
            for k in moved:
                self.parameters[k].mul_(1 - self.rate * self.decay)
        adam(
            [self.parameters[k] for k in moved],
            [g for p in self.parameters if (g := p.grad) is not None],
            [self._mean[k] for k in moved],
            [self._square[k] for k in moved],
            [],
            [self._steps[k] for k in moved],
            fused=self.fused or None,  # None takes what is fast on the device
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
