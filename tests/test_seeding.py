import numpy as np
import torch
from scipy import stats

from sbi_active.seeding import forked_generators, row_normals, row_seeds, row_uniforms


def test_rows_depend_on_seed_and_index_alone():
    together = row_normals(row_seeds(3, 100), 4)
    apart = row_normals(row_seeds(3, 40, first=60), 4)
    assert torch.equal(together[60:], apart)
    assert not torch.equal(together, row_normals(row_seeds(4, 100), 4))


def test_row_normals_are_standard_normal_and_uncorrelated():
    draws = row_normals(row_seeds(1, 20_000), 5).numpy()
    assert stats.kstest(draws.ravel(), "norm").pvalue > 1e-3
    correlation = np.corrcoef(draws.T)[np.triu_indices(5, 1)]
    assert np.abs(correlation).max() < 4 / np.sqrt(20_000)
    # and along rows, whose seeds are neighbors
    assert abs(np.corrcoef(draws[1:, 0], draws[:-1, 0])[0, 1]) < 4 / np.sqrt(20_000)


def test_row_uniforms_are_uniform_and_continue_the_stream():
    seeds = row_seeds(2, 20_000)
    draws = row_uniforms(seeds, 4)
    assert stats.kstest(draws.numpy().ravel(), "uniform").pvalue > 1e-3
    assert torch.equal(row_uniforms(seeds, 2, first=2), draws[:, 2:])
    assert torch.equal(row_uniforms(seeds[[7, 3]], 4), draws[[7, 3]])
    normals = stats.norm.ppf(draws.numpy())
    assert np.allclose(row_normals(seeds, 4).numpy(), normals, atol=1e-9)


def test_fork_seeds_inside_and_restores_outside():
    torch.manual_seed(5)
    np.random.seed(5)
    expected = torch.rand(1), np.random.rand()
    torch.manual_seed(5)
    np.random.seed(5)
    with forked_generators(1, "key"):
        first = torch.rand(3), np.random.rand(3)
    with forked_generators(1, "key"):
        second = torch.rand(3), np.random.rand(3)
    assert torch.equal(first[0], second[0])
    assert (first[1] == second[1]).all()
    assert (torch.rand(1), np.random.rand()) == expected
