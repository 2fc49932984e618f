"""A small bank of four segments, for what damages it."""

import torch

from sbi_active import Bank
from sbi_active.simulation import Simulations


def simulator(theta, action):
    return theta


def prior():
    return torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))


def fill(bank, seeds=(0, 1, 2, 3)):
    for seed in seeds:
        theta = torch.full((5, 2), float(seed))
        rows = Simulations(theta, theta[:, :1], theta)
        bank.append(rows, seed=seed, proposal=prior(), label="prior")


def segment(folder, first, last=None):
    return folder / "segments" / f"{first:08d}-{last or first:08d}.h5"


def appended(folder):
    with Bank(folder, simulator=simulator) as bank:
        fill(bank, (9,))


def filled(path):
    """Return the folder of a bank with four segments of five rows."""
    with Bank(path, simulator=simulator) as bank:
        fill(bank)
    return bank.path
