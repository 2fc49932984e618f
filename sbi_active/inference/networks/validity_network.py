"""Probability that a simulation gives a measurement, as a function of its inputs."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

#: Choices: one hidden layer, and steps of Adam over all rows at once, which at this
#: rate move a weight by 3 at most.
WIDTH = 32
NUM_ITERATIONS = 300
LEARNING_RATE = 0.01
WEIGHT_DECAY = 1e-3  # where few rows are invalid, the edge between stays soft


class ValidityNetwork(nn.Module):
    r"""Logistic regression on learned features, :math:`P(\text{valid} | \theta, \xi)`.

    Args:
        seen: Standardized inputs, shape (n, p).
        valid: Mask of the rows that gave a measurement, shape (n,), bool; both kinds
            occur.
    """

    def __init__(self, seen: Tensor, valid: Tensor) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(seen.shape[1], WIDTH), nn.Tanh(), nn.Linear(WIDTH, 1)
        )
        share = valid.double().mean().clamp(1e-3, 1 - 1e-3)
        with torch.no_grad():  # start at the share of valid rows
            last = self.net[-1]
            assert isinstance(last, nn.Linear)
            last.weight.mul_(0.1)
            last.bias.fill_(float(share.logit()))
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY
        )
        sign = valid.to(seen.dtype) * 2 - 1
        for _ in range(NUM_ITERATIONS):
            optimizer.zero_grad(set_to_none=True)
            loss = -logsigmoid(sign * self.net(seen)[:, 0]).mean()
            loss.backward()
            optimizer.step()
        self.zero_grad(set_to_none=True)

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log probabilities of a measurement and of none, each (n,)."""
        logit = self.net(seen)[:, 0]
        return logsigmoid(logit), logsigmoid(-logit)
