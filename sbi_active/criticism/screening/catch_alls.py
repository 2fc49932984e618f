r"""What else may be the matter with the bare model, in closed form.

Larger noise scales all Gram matrices, a gross error of one trial is a residual process
in that trial alone, "unexplained" one in all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.misfit.processes import Errors, integrated
from sbi_active.criticism.misfit.search import Candidate
from sbi_active.criticism.rivals.error_models import LOG_2PI, NoiseGrid
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


def log_scatter(bare: Candidate, errors: Errors, noise: NoiseGrid) -> float:
    """Return the log evidence of the bare model under larger noise.

    Args:
        bare: The model.
        errors: That its Gram matrices are of.
        noise: Whose scales and their probabilities are taken.
    """
    n, grams = len(errors.cells), bare.grams
    gram, log_det = grams.gram[:n].sum(1), grams.log_det[:n].sum(1)
    count = grams.count.sum()
    found = []
    for scale, log_p in zip(noise.scales, noise.log_scale_prior, strict=True):
        log_z = _log_evidence(bare, gram / scale**2, log_det, count)
        found.append(log_z - count * np.log(scale) + errors.log_cells + log_p)
    return float(log_sum_exp(np.concatenate(found)))


def log_one_part(bare: Candidate, errors: Errors) -> Array:
    """Return the log evidence of a residual process in each part alone, shape (f,).

    The sensor's error elsewhere is the most probable of those declared.

    Args:
        bare: The model.
        errors: That its Gram matrices are of.
    """
    n, grams = len(errors.cells), bare.grams
    some = slice(n, n + errors.num_processes)
    own = int(np.argmax(errors.log_cells))
    gram, log_det = grams.gram[own].sum(0), grams.log_det[own].sum()
    found = []
    for k in range(errors.num_folds):
        with_process = gram - grams.gram[own, k] + grams.gram[some, k]
        dets = log_det - grams.log_det[own, k] + grams.log_det[some, k]
        log_z = _log_evidence(bare, with_process, dets, grams.count.sum())
        found.append(log_sum_exp(log_z) - np.log(len(log_z)))
    return np.array(found)


def log_without(candidate: Candidate, errors: Errors) -> Array:
    """Return the log evidence of a model without each part of the trials, (f,)."""
    parts, found = np.arange(errors.num_folds), []
    for k in parts:
        posterior = errors.posterior(
            candidate.model, candidate.grams, parts != k, process=False
        )
        found.append(posterior.log_sensor)
    return np.array(found)


def _log_evidence(bare: Candidate, gram: Array, log_det: Array, count: int) -> Array:
    shift = np.eye(gram.shape[-1])
    shift[1:, 0] = -bare.model.center
    log_z = integrated(shift.T @ gram @ shift, bare.model, 1.0)[0]
    return log_z - 0.5 * (log_det + count * LOG_2PI)
