import warnings

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import reuse
from tests.simulation.bank.filled import append

NOISE = 0.3


def simulator(theta, action, seeds):
    return theta + action + NOISE * row_normals(seeds, 1).float()


def normal(mean, sd):
    return Independent(Normal(torch.tensor([mean]), torch.tensor([sd])), 1)


PRIOR, ROUND = normal(0.0, 2.0), normal(3.0, 1.0)
TARGET = normal(1.0, 0.5)


@pytest.fixture
def bank(tmp_path):
    """Rows of both proposals, at two actions."""
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        for proposal in (PRIOR, ROUND):
            theta = proposal.sample((2_000,))
            action = torch.randint(2, (2_000, 1)).float()
            store = bank.drawn_from(proposal)
            simulate(simulator, theta, action, seed=0, store=store)
        yield bank


def z_score(values, weights, exact):
    """Return the error of a weighted mean in its own standard errors."""
    mean = (weights * values).sum()
    error = (weights**2 * (values - mean) ** 2).sum().sqrt()
    return float((mean - exact) / error)


def test_weighted_rows_have_the_law_of_the_target(bank):
    reused = reuse(bank, TARGET)
    rows = reused.simulations()
    theta, weights = rows.theta[:, 0].double(), reused.weights
    assert float(weights.sum()) == pytest.approx(1)
    assert len(reused) == 4_000
    assert abs(z_score(theta, weights, 1.0)) < 4
    assert abs(z_score((theta - 1) ** 2, weights, 0.25)) < 4
    for action in (0.0, 1.0):
        some = rows.action[:, 0] == action
        w = weights[some] / weights[some].sum()
        x = rows.x[some, 0].double()
        assert abs(z_score(x, w, 1 + action)) < 4
        assert abs(z_score((x - 1 - action) ** 2, w, 0.25 + NOISE**2)) < 4
    # Negative control: the same rows, unweighted.
    equal = torch.full_like(weights, 1 / len(weights))
    assert abs(z_score(theta, equal, 1.0)) > 10


def test_few_effective_rows_are_told(bank):
    far = normal(-7.5, 0.3)
    with pytest.warns(UserWarning, match=r"4000 rows of the bank are worth \d+\.\d"):
        reused = reuse(bank, far)
    assert reused.effective_sample_size < 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reuse(bank, TARGET)


def test_a_target_elsewhere(bank):
    far = BoxUniform(torch.tensor([50.0]), torch.tensor([51.0]))
    with pytest.raises(ValueError, match="got 4000 rows, all of density 0; simulate"):
        reuse(bank, far)
    empty = Bank(bank.path.parent / "empty", simulator=simulator)
    with pytest.raises(ValueError, match=r"expected rows in .*; got none"):
        reuse(empty, TARGET)
    with empty:
        append(empty, bank.read(slice(0, 9)), 0)
        with pytest.raises(ValueError, match="got none whose proposal is known"):
            reuse(empty, TARGET)
