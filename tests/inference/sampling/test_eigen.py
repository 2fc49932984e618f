"""Eigenvalues where divide and conquer does not converge."""

import numpy as np
import pytest

from sbi_active.inference.sampling.eigen import eigh


def symmetric(*shape):
    a = np.random.default_rng(0).standard_normal(shape)
    return a + np.swapaxes(a, -1, -2)


@pytest.fixture
def never_converges(monkeypatch):
    def fails(matrix):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fails)


@pytest.mark.parametrize("shape", [(6, 6), (2, 3, 6, 6)])
def test_robust_representations_take_over(never_converges, shape):
    a = symmetric(*shape)
    values, vectors = eigh(a)
    assert values.shape == shape[:-1]
    assert (np.diff(values) >= 0).all()
    again = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    assert np.allclose(again, a, rtol=0, atol=1e-12)
