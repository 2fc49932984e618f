"""A known function on a box and a category, as the objective of a search."""

import torch

from sbi_active import BoxActions, DiscreteActions, MixedActions
from sbi_active.design.search import Evaluations, Objective

SPACE = MixedActions(BoxActions(0.0, 4.0), DiscreteActions([3.0, 5.0, 9.0]))
CENTER, HEIGHT = torch.tensor([3.2, 0.6, 1.7]), torch.tensor([1.0, 1.6, 1.3])
BEST = [0.6, 5.0]  # the action of the highest of the local optima


def utility(action):
    k = (action[:, 1:] == torch.tensor([3.0, 5.0, 9.0])).int().argmax(1)
    bump = HEIGHT[k] * torch.exp(-((action[:, 0] - CENTER[k]) ** 2) / 0.5)
    return (bump + 0.3 * torch.cos(4 * (action[:, 0] - CENTER[k]))).double()


class Counted:
    """Evaluates the utility with a known error, and remembers what it was asked."""

    def __init__(self, error: float = 0.05, valid=None) -> None:
        self.error, self.asked, self.valid = error, [], valid
        self.generator = torch.Generator().manual_seed(0)

    def __call__(self, action):
        self.asked.append(action)
        noise = torch.randn(len(action), generator=self.generator).double()
        share = torch.ones(len(action)) if self.valid is None else self.valid(action)
        return Evaluations(
            action,
            utility(action) + self.error * noise,
            torch.full((len(action),), self.error).double(),
            share.double(),
        )


def objective(evaluate, *, permitted=None, num=40, seed=0, least=0.0):
    return Objective(
        actions=SPACE,
        permitted=permitted or (lambda action: torch.ones(len(action)).bool()),
        evaluate=evaluate,
        num_evaluations=num,
        seed=seed,
        min_probability_valid=least,
    )
