"""Adam on the kernels of torch."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Adam, a kernel for all of a parameter's moments.

    It is ``torch.optim.Adam(fused=True)`` to the last bit. That imports torch's
    compiler at its first step, which takes three CPU seconds of a process.

    Args:
        parameters: Parameters that are changed in place.
        rate: Learning rate.

    Attributes:
        initial_rate: Learning rate that it began with.
        rate: Learning rate of the next step.

    References:
        Kingma & Ba, ICLR 2015.
    """

    def __init__(self, parameters: Iterable[Tensor], *, rate: float) -> None:
        self.parameters = [*parameters]
        self.initial_rate = self.rate = rate
        self._mean = [torch.zeros_like(p) for p in self.parameters]
        self._square = [torch.zeros_like(p) for p in self.parameters]
        # Counts are where the kernel runs, and in single precision.
        self._steps = [
            torch.zeros((), dtype=torch.float32, device=p.device)
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
        adam(
            [self.parameters[k] for k in moved],
            [g for p in self.parameters if (g := p.grad) is not None],
            [self._mean[k] for k in moved],
            [self._square[k] for k in moved],
            [],
            [self._steps[k] for k in moved],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
