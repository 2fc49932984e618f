r"""Evidence of effects whose priors have an unknown scale.

A declared prior is often wrong by a factor: which effect a simulator lacks is better
known than how strong it is. So every effect's prior is the mixture, with equal weights,
of the declared one and of twins a third and three times as wide about the null,

.. math::
    \bar p(\phi) = \frac13 \sum_{s \in \{1/3, 1, 3\}}
        \frac{1}{s^d}\, p\bigl(\phi_0 + (\phi - \phi_0) / s\bigr), \qquad
    \bar Z = Z\, E_{p(\phi | x)}\left[\frac{\bar p(\phi)}{p(\phi)}\right] .

Where the declared scale is right this costs at most .7 nats, where it is three times
too small it saves many. A prior between two bounds says what is possible and is kept,
and so is one whose null is infinite, about which a scale has no meaning.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

#: Scales of an effect's prior in units of the declared one, equally likely.
SCALES = (1 / 3, 1.0, 3.0)


def log_evidence(
    rivals: RivalSet,
    key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
    *,
    factor: float = 1.0,
) -> tuple[float, float]:
    """Return the log evidence of a rival under unknown scales, and its error.

    Args:
        rivals: The models.
        key: Key of the model.
        factor: Factor by which the declared scales are multiplied first.

    Returns:
        Log evidence and its Monte Carlo standard error, nats.
    """
    fit = rivals.fit(key)
    rival, sample, evidence = fit.rival, fit.sample, fit.evidence
    if not key.effects or not np.isfinite(evidence.log_evidence):
        return evidence.log_evidence, evidence.standard_error
    some = sample.weight > 0
    z = torch.from_numpy(rival.coordinates.to_z(sample.u[some]))
    log_w = np.log(sample.weight[some])
    bounded = np.isfinite(rival.coordinates.low) & np.isfinite(rival.coordinates.high)
    for name, place in rival.columns().items():
        if name not in key.effects or bounded[place].any():
            continue
        effect, phi = rivals.effects[name], z[:, place]
        null = effect.null_phi(len(phi))
        if not bool(null.isfinite().all()):
            continue
        log_p = [
            effect.log_prob(null + (phi - null) / (s * factor)).double().numpy()
            - effect.phi_dim * np.log(s * factor)
            for s in SCALES
        ]
        mixture = log_sum_exp(np.stack(log_p), axis=0) - np.log(len(SCALES))
        declared = effect.log_prob(phi).double().numpy()
        # A mode at a bound may round to beyond, where no scale has a density.
        inside = np.isfinite(declared)
        log_w[inside] += mixture[inside] - declared[inside]
    change = log_sum_exp(log_w)
    num = len(sample.weight)
    effective = np.exp(2 * change - log_sum_exp(2 * log_w))
    error_of_mean = np.sqrt(max(num / effective - 1, 0.0) / num)
    # Tempered particles have equal weights, which say nothing of the evidence's error.
    spread = float(max(evidence.standard_error, error_of_mean))
    return float(evidence.log_evidence + change), spread
