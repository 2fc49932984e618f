r"""Formula effects: guesses for what no declared effect explains.

Each adds :math:`c\, g` to the noise-free output, with g one elementary function of an
entry of the action or of the output itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Independent, StudentT

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import UNEXPLAINED, ModelKey

Array = NDArray[Any]

#: Nats by which a formula must beat the residual process to be printed.
MARGIN = 2.0
#: Bound on exponents, so that a formula stays finite.
LARGEST_EXPONENT = 20.0

#: Cosine short of 1 at which two terms are one.
SAME = 1e-9
#: Degrees of freedom of a coefficient's prior: terms are often far from typical.
TAIL = 3.0

TERMS: dict[str, Callable[[Tensor], Tensor]] = {
    "1": torch.ones_like,
    "{}": lambda v: v,
    "{}^2": lambda v: v**2,
    "{}^3": lambda v: v**3,
    "|{}|": torch.abs,
    "|{}|^1.5": lambda v: v.abs() ** 1.5,
    "step({})": lambda v: (v > 0).to(v.dtype),
    "sign({})": torch.sign,
    "sin({})": torch.sin,
    "cos({})": torch.cos,
    "exp({})": lambda v: v.clamp(max=LARGEST_EXPONENT).exp(),
    "relu({})": torch.relu,
}


def formula_effects(rivals: RivalSet) -> list[Effect]:
    """Return one effect a formula, with a prior that gives it the process's size.

    A coefficient has a Student-t prior, its scale such that the term over the trials is
    as large as the middle amplitude of the residual process: the geometric mean of the
    noise and the spread of the prior predictive.

    Args:
        rivals: The models that the formulas compete with.
    """
    trials = rivals.trials
    names = ["xi"]
    if trials.action.shape[1] > 1:
        names = [f"xi_{i + 1}" for i in range(trials.action.shape[1])]
    sd = rivals.noise.typical_sd
    amplitude = float(np.median(np.sqrt(sd * np.maximum(rivals.spread, sd))))
    if rivals.simulator.is_stochastic:
        amplitude = float(np.median(rivals.spread))
    x = trials.x.double().reshape(len(trials.x), -1)
    if trials.action_is_label:
        names = []
    of_action = [(name, trials.action[:, [j]], j) for j, name in enumerate(names)]
    found, seen = [], torch.zeros(0, int(x.isfinite().sum()), dtype=torch.float64)
    for name, value, j in [*of_action, ("x", x, None)]:
        for pattern, g in TERMS.items():
            term = g(value.double()).expand_as(x)[x.isfinite()]
            size = float(term.square().mean().sqrt())
            if not np.isfinite(size) or size < 1e-9:
                continue
            term = term / term.norm()
            if bool(((seen @ term).abs() > 1 - SAME).any()):
                continue  # what a simpler formula is on these trials
            seen = torch.cat([seen, term[None]])
            apply = _of_output(g) if j is None else _of_action(g, j)
            found.append(_effect(pattern.format(name), apply, amplitude / size))
    return found


def guess(rivals: RivalSet) -> tuple[tuple[str, float], ...]:
    """Return formulas that beat the residual process, best first.

    Args:
        rivals: The models; their evidence of "unexplained" is the bar.

    Returns:
        Formulas and their log evidence above that of the residual process, only those
        more than 2 nats above; empty where there is none.
    """
    bar = rivals.fit(ModelKey(error=UNEXPLAINED)).evidence.log_evidence
    effects = formula_effects(rivals)
    others = RivalSet(
        rivals.model,
        rivals.prior,
        rivals.trials,
        [*effects, *rivals.nuisances],
        actions=rivals.actions,
        seed=rivals.seed,
        reference=bar,
    )
    found = {e.name: log_evidence(others, ModelKey((e.name,))) for e in effects}
    gains = {name: value - bar for name, (value, _) in found.items()}
    best = sorted(gains, key=gains.__getitem__)[::-1]
    top, top_error = found[best[0]]
    # Of those that the Monte Carlo error leaves equal, the simplest, which comes first.
    for name, (value, error) in found.items():
        if value >= top - 2 * np.hypot(error, top_error):
            best.remove(name)
            best.insert(0, name)
            break
    return tuple((name, gains[name]) for name in best if gains[name] > MARGIN)


def _effect(name: str, apply: Any, scale: float) -> Effect:
    return Effect(
        name,
        hook="observation",
        prior=Independent(StudentT(TAIL, torch.zeros(1), torch.full((1,), scale)), 1),
        null=0.0,
        apply=apply,
        family="formula",
        describe="a guess, not declared",
    )


def _of_action(g: Callable[[Tensor], Tensor], entry: int) -> Any:
    def apply(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
        term = phi[:, 0] * g(action[:, entry])
        return x + term.reshape(-1, *[1] * (x.ndim - 1))

    return apply


def _of_output(g: Callable[[Tensor], Tensor]) -> Any:
    def apply(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
        return x + phi[:, 0].reshape(-1, *[1] * (x.ndim - 1)) * g(x)

    return apply
