"""The entropy by nearest neighbors, where there is a formula for it."""

import torch

from sbi_active.design.estimators.entropy import nearest_neighbor_entropy


def test_outcomes_that_are_the_same_have_the_entropy_of_their_rounding():
    x = torch.randn(200, 1, generator=torch.Generator().manual_seed(0)).double()
    repeated = x[:20].repeat(10, 1)
    each = nearest_neighbor_entropy(repeated, 3)
    assert each.isfinite().all()
    assert float(each.mean()) < -8
