"""Refinement where some parameters take a few values: one belief for each."""

from __future__ import annotations

import copy
import uuid
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.beliefs.enumerated import EnumeratedBelief, Enumeration
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.seeding import derive_seed
from sbi_active.simulation.model import SimulatorModel

NEGLIGIBLE = 0.01  # probability of values whose belief decides nothing


class Filled:
    """A function of the continuous parameters, the discrete ones at one combination.

    Args:
        fn: ``fn(theta, action, ...)`` of all parameters, of rows or of one.
        enumeration: Which parameters are discrete.
        k: Number of the combination.
    """

    def __init__(
        self, fn: Callable[..., Any], enumeration: Enumeration, k: int
    ) -> None:
        self._fn, self._enumeration, self._k = fn, enumeration, k
        self.__wrapped__ = fn  # whose signature it has

    def __call__(self, theta: Any, *arguments: Any, **keywords: Any) -> Any:
        """Return what the function gives."""
        full = self._enumeration.filled(self._k, torch.as_tensor(theta))
        given = full.numpy() if isinstance(theta, np.ndarray) else full
        return self._fn(given, *arguments, **keywords)


def filled_simulator(simulator: Any, enumeration: Enumeration, k: int) -> Any:
    """Return a simulator of the continuous parameters alone, its noise as declared."""
    if not isinstance(simulator, SimulatorModel):
        return Filled(simulator, enumeration, k)
    twin = copy.copy(simulator)
    twin.fn = Filled(simulator.fn, enumeration, k)
    twin.parameter_names = None
    twin._token = uuid.uuid4().hex  # workers keep simulators by it
    return twin


def enumerated(
    refine: Callable[..., Any],
    simulator: Callable[..., Any],
    prior: Distribution,
    enumeration: Enumeration,
    action: Tensor,
    x: Tensor,
    seed: int,
    **options: Any,
) -> EnumeratedBelief:
    """Return the belief over all parameters: one of the others for each combination.

    Each is computed afresh; what was simulated for earlier trials is not kept.

    Args:
        refine: Computes the belief of a simulator of continuous parameters.
        simulator: Simulator of all parameters.
        prior: Original prior.
        enumeration: The prior as a mixture.
        action: Executed actions, shape (t, action_dim).
        x: Their outcomes, shape (t, *x_shape).
        seed: Seed of everything random.
        options: Further arguments of refine.

    Raises:
        UnexplainedOutcomeError: If no combination explains the outcomes.
    """
    parts: list[Belief] = []
    log_mass, kept, fault = [], [], None
    for k in range(len(enumeration.values)):
        own = filled_simulator(simulator, enumeration, k)
        values = derive_seed(seed, "values", k)
        try:
            part = refine(own, enumeration.rest, action, x, seed=values, **options)
        except UnexplainedOutcomeError as error:
            fault = error
            continue
        kept.append(k)
        parts.append(part)
        log_mass.append(float(enumeration.log_prob[k]) + part.log_evidence)
    if not parts:
        assert fault is not None
        raise fault
    mass = torch.tensor(log_mass, dtype=torch.float64)
    is_inflated = torch.tensor([_is_inflated(part) for part in parts])
    if not bool(is_inflated.all()):
        # Evidence under wider noise is not comparable: trials rule these values out.
        mass[is_inflated] = -torch.inf
    some = replace(
        enumeration,
        values=enumeration.values[kept],
        log_prob=enumeration.log_prob[kept],
    )
    belief = EnumeratedBelief(prior, some, parts, mass.softmax(0))
    belief.diagnostics = _diagnosed(belief, float(mass.logsumexp(0)))
    return belief


def _is_inflated(belief: Belief) -> bool:
    """Return whether trials contradict each other, so that the noise was inflated."""
    return "noise_inflation" in belief.diagnostics.figures


def _diagnosed(belief: EnumeratedBelief, log_evidence: float) -> Diagnostics:
    """Return what is known of a mixture: the worst of the parts that count."""
    known = [part.diagnostics for part in belief.parts]
    counts = belief.probability > NEGLIGIBLE
    some = [d for d, is_seen in zip(known, counts, strict=True) if is_seen]
    effective = [d.effective_sample_size for d in some]
    texts = [
        f"where the discrete parameters are {values.tolist()}: {text}"
        for values, d, is_seen in zip(belief.values, known, counts, strict=True)
        for text in (d.warnings if is_seen else ())
    ]
    found = Diagnostics(
        trustworthy=all(d.trustworthy is not False for d in some),
        num_simulations=sum(d.num_simulations for d in known),
        num_missing=sum(d.num_missing for d in known),
        effective_sample_size=min(e for e in effective if e is not None),
    )
    return found.warned(*texts).extended(
        log_evidence=log_evidence,
        probabilities=[
            {"values": v.tolist(), "probability": float(p)}
            for v, p in zip(belief.values, belief.probability, strict=True)
        ],
    )
