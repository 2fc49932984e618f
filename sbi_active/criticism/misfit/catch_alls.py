r"""Catch-all alternatives to the bare model, in closed form.

Larger noise scales all Gram matrices, a gross error of one trial is a residual process
in that trial alone, "unexplained" one in all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.linear.candidate import Candidate
from sbi_active.criticism.linear.errors import Errors, integrated
from sbi_active.criticism.rivals.error_models import LOG_2PI
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


def log_scaled(bare: Candidate, errors: Errors, scales: Array) -> Array:
    """Return the log evidence of the bare model under other sizes of the noise, (s,).

    Args:
        bare: The model.
        errors: Errors with the sensor's error.
        scales: Factors on it, one a number, shape (s, N), or one for all, (s, 1).
    """
    scales = np.broadcast_to(scales, (len(scales), len(bare.model.residual)))
    found = np.empty((len(scales), len(errors.cells)))
    for i, cell in enumerate(errors.cells):
        white = cell.whiten(bare.model.rows.T / scales[:, None])  # (s, k, N)
        gram = white @ np.swapaxes(white, 1, 2)
        log_det = 2 * (cell.log_scale + np.log(scales).sum(1))
        found[:, i] = _log_evidence(bare, gram, log_det, scales.shape[1])
    return log_sum_exp(found + errors.log_cells, axis=1)


def log_one_part(bare: Candidate, errors: Errors) -> Array:
    """Return the log evidence of a residual process in each part alone, shape (f,).

    The sensor's error elsewhere is the most probable of those declared.

    Args:
        bare: The model.
        errors: Errors that its Gram matrices are of.
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
