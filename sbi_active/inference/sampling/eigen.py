"""Eigenvalues of symmetric matrices."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from sbi_active.arrays import Array


def eigh(matrix: Array) -> tuple[Array, Array]:
    """Return eigenvalues, smallest first, and eigenvectors, as ``numpy.linalg.eigh``.

    The divide and conquer of LAPACK that NumPy calls fails, with some builds, on good
    matrices of which many eigenvalues are equal. Relatively robust representations find
    these as well.

    Args:
        matrix: Symmetric, shape (..., n, n).

    Returns:
        Shapes (..., n) and (..., n, n).

    Raises:
        numpy.linalg.LinAlgError: If neither converges, as where it is not finite.

    References:
        Dhillon, Parlett and Voemel, ACM Trans. Math. Software 32 (2006).
    """
    try:
        return np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        stack = matrix.reshape(-1, *matrix.shape[-2:])
        found = [scipy.linalg.eigh(one, driver="evr") for one in stack]
    values = np.stack([value for value, _ in found])
    vectors = np.stack([vector for _, vector in found])
    return values.reshape(matrix.shape[:-1]), vectors.reshape(matrix.shape)
