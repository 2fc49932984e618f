"""The best points that lie apart, against a search through all of them."""

import pytest
import torch

from sbi_active.search.sequential import spaced


@pytest.mark.parametrize("seed", range(5))
def test_each_is_the_best_of_those_that_are_far_from_better_ones(seed):
    generator = torch.Generator().manual_seed(seed)
    category = torch.randint(2, (60, 1), generator=generator).double()
    point = torch.cat([torch.rand(60, 2, generator=generator).double(), category], 1)
    score = torch.rand(60, generator=generator)
    chosen = spaced(point, score, 8, num_continuous=2, apart=0.3)
    assert len(chosen) == 8
    free = torch.ones(60, dtype=torch.bool)
    for i in chosen:
        assert i == torch.where(free, score, -1.0).argmax()
        near = (point[:, :2] - point[i, :2]).norm(dim=1) < 0.3
        free &= ~(near & (point[:, 2] == point[i, 2]))


def test_fewer_where_there_is_no_room():
    point = torch.tensor([[0.0], [0.1], [0.2], [1.0]])
    chosen = spaced(point, torch.arange(4.0), 4, num_continuous=1, apart=0.5)
    assert chosen.tolist() == [3, 2]
