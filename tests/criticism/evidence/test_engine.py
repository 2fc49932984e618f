"""The engine on a model of the closed loop, against closed forms."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.evidence.settings import THOROUGH, settings_of
from sbi_active.inference.engine import infer, search
from tests.criticism.evidence.linear import exact, linear_rival

FEW = settings_of(8, is_bare=False)


def fit(seed=0, settings=FEW, **given):
    rival, rng = linear_rival(), np.random.default_rng(seed)
    found = search(rival, rng, settings=THOROUGH)
    return rival, infer(rival, rng, found=found, settings=settings, **given)


def test_the_standard_error_claims_what_repeated_runs_show():
    closed, found = exact(), [fit(seed)[1] for seed in range(20)]
    gap = np.array([f.log_evidence for f in found]) - closed.log_evidence
    claimed = np.mean([f.standard_error for f in found])
    assert 0.5 * claimed < np.sqrt((gap**2).mean()) < 1.7 * claimed


def test_a_likelihood_of_zero_has_no_evidence():
    rival, rng = linear_rival(), np.random.default_rng(0)
    found = search(rival, rng, settings=THOROUGH)
    rival.log_likelihood = lambda u, floor=0.0: np.full(len(u), -np.inf)  # type: ignore[method-assign]
    none = infer(rival, rng, found=found, settings=FEW)
    assert none.log_evidence == -np.inf
    assert none.effective_sample_size == 0
