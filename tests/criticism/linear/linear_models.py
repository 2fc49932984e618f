"""Linear models with derivatives that are given."""

import numpy as np

from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.results import ModelKey


def linear_model(residual, jacobian, **changes) -> LinearModel:
    """Return a model whose priors are wide and unbounded, but for changes."""
    num, dim = jacobian.shape
    parts = {
        "key": ModelKey(),
        "u": np.zeros(dim),
        "center": np.zeros(dim),
        "sd": np.full(dim, 1e3),
        "scaled": np.zeros(dim, bool),
        "low": np.full(dim, -np.inf),
        "high": np.full(dim, np.inf),
        "trial_of": np.full(dim, -1),
        "scale": np.ones(num),
        "offset": np.zeros(num),
    }
    given = {"residual": residual, "jacobian": jacobian, "num": num}
    return LinearModel(**(parts | given | changes))
