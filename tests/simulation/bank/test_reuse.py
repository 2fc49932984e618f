import warnings

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import reuse

NOISE = 0.3


def simulator(theta, action, seeds):
    return theta + action + NOISE * row_normals(seeds, 1).float()


def normal(mean, sd):
    return Independent(Normal(torch.tensor([mean]), torch.tensor([sd])), 1)


PRIOR, ROUND = normal(0.0, 2.0), normal(3.0, 1.0)
PROPOSALS = {"prior": PRIOR, "round 1": ROUND}
TARGET = normal(1.0, 0.5)


def fill(bank, *, num_rows=2_000, seed=0, actions=((0.0, 1.0), (0.0, 1.0))):
    """Store rows of both proposals, each with actions of its own."""
    torch.manual_seed(seed)
    for (label, proposal), own in zip(PROPOSALS.items(), actions, strict=True):
        theta = proposal.sample((num_rows,))
        action = torch.tensor(own)[torch.randint(len(own), (num_rows, 1))]
        store = bank.drawn_from(proposal, label=label)
        simulate(simulator, theta, action, seed=seed, store=store)


@pytest.fixture
def bank(tmp_path):
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        fill(bank)
        yield bank


def z_score(values, weights, exact):
    """Return the error of a weighted mean in its own standard errors."""
    mean = (weights * values).sum()
    error = (weights**2 * (values - mean) ** 2).sum().sqrt()
    return float((mean - exact) / error)


@pytest.mark.parametrize("proposals", [PROPOSALS, None])
def test_weighted_rows_have_the_law_of_the_target(bank, proposals):
    reused = reuse(bank, TARGET, proposals=proposals)
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


def test_proposals_may_have_met_with_other_actions(tmp_path):
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        uneven = ((0.0, 0.0, 0.0, 1.0), (0.0, 1.0, 1.0, 1.0))
        fill(bank, num_rows=10_000, actions=uneven)
    reused = reuse(bank, TARGET, proposals=PROPOSALS)
    theta, own = bank.read().theta, reused.simulations().action[:, 0] == 0
    mixture = 0.5 * (PRIOR.log_prob(theta).exp() + ROUND.log_prob(theta).exp())
    mixed = (TARGET.log_prob(theta).exp() / mixture).double()
    scores = []
    for weights in (reused.weights, mixed):
        w = weights[own] / weights[own].sum()
        scores.append(z_score(theta[own, 0].double(), w, 1.0))
    assert abs(scores[0]) < 4
    assert abs(scores[1]) > 6  # negative control: one mixture for all actions


def test_few_effective_rows_are_told(bank):
    far = normal(-7.5, 0.3)
    with pytest.warns(UserWarning, match=r"4000 rows of the bank are worth \d+\.\d"):
        reused = reuse(bank, far, proposals=PROPOSALS)
    assert reused.effective_sample_size < 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reuse(bank, TARGET, proposals=PROPOSALS)


def test_proposals_that_rows_were_not_drawn_from_are_refused(bank):
    with pytest.raises(ValueError, match="got none for 'round 1'; give it"):
        reuse(bank, TARGET, proposals={"prior": PRIOR})
    with pytest.raises(ValueError, match=r"'prior'\] to be what its rows were drawn"):
        reuse(bank, TARGET, proposals={"prior": ROUND, "round 1": ROUND})


def test_a_target_elsewhere(bank):
    far = BoxUniform(torch.tensor([50.0]), torch.tensor([51.0]))
    with pytest.raises(ValueError, match="got 4000 rows, all of density 0; simulate"):
        reuse(bank, far)
    empty = Bank(bank.path.parent / "empty", simulator=simulator)
    with pytest.raises(ValueError, match=r"expected rows in .*; got none"):
        reuse(empty, TARGET)
    with empty:
        empty.append(bank.read(slice(0, 9)), seed=0)
        for proposals in (None, PROPOSALS):
            with pytest.raises(ValueError, match="got none whose proposal is known"):
                reuse(empty, TARGET, proposals=proposals)
