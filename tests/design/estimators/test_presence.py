"""How probable a complete outcome is, against the rule that made outcomes so."""

import math

import torch

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.emulator import MeanEmulator
from sbi_active.design.estimators.presence import completeness


def world(lost, again=None, n=2_000):
    """Return simulations of which ``lost`` (a, n) have no measurement."""
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(n, 1, generator=generator)
    x = torch.where(lost(theta.T, generator), torch.nan, theta.T)[..., None]
    replicate = x
    if again is not None:
        replicate = torch.where(again(theta.T, generator), torch.nan, theta.T)[
            ..., None
        ]
    action = torch.arange(float(len(x)))[:, None]
    rows = CandidateSimulations(theta, action, x, replicate=replicate)
    return rows, MeanEmulator.fit(theta.double(), theta.double())


def at(emulator, theta):
    return emulator.coordinates(torch.tensor(theta).double()[:, None])


def test_an_edge_is_that_of_the_nearest_simulation():
    rows, emulator = world(lambda theta, _: theta > 0.5)
    (edge,) = completeness(rows)
    inside = edge(at(emulator, [-2.0, 0.4, 0.6, 2.0]), emulator)
    assert inside.tolist() == [0, 0, -math.inf, -math.inf]
    share = float((rows.theta <= 0.5).double().mean())
    assert math.isclose(float(edge.log_probability), math.log(share))


def test_a_chance_is_a_smooth_function_of_the_parameters():
    def lost(theta, generator):
        return torch.rand(theta.shape, generator=generator) > theta.sigmoid()

    rows, emulator = world(lost, lost)
    (chance,) = completeness(rows)
    theta = [-1.5, -0.5, 0.5, 1.5]
    probability = chance(at(emulator, theta), emulator).exp()
    assert (probability - torch.tensor(theta).sigmoid()).abs().max() < 0.06


def test_rows_that_faults_lost_do_not_count():
    rows, _ = world(lambda theta, _: theta > 0.0)
    lost = rows.theta.T > 0.0  # all that are incomplete
    rows = CandidateSimulations(
        rows.theta, rows.action, rows.x, replicate=rows.x, missing=lost
    )
    (counted,) = completeness(rows)
    assert float(counted.log_probability) == 0
