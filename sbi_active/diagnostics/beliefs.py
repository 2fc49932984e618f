r"""Is a refined belief right? Asked at run time, without any further truth.

There are two checks, which find different errors:

- Refits. The same trials are inferred again with other seeds. A belief that lost a
  mode, or is too wide or narrow by accident, differs from these in nats.
- Posterior SBC. Parameters from the belief, outcomes of the executed actions simulated
  with them, and both old and new trials inferred with the same settings: the parameters
  are then draws of that posterior, and their ranks in it are uniform. Errors that every
  inference makes show here, the more the more the new outcomes tell, which is why each
  action is simulated ``num_copies`` times.

No check around a belief can find a mode that each inference loses in the same way;
:func:`.check_calibration` draws from all of the prior.

References:
    Saeilynoja, Schmitt, Buerkner & Vehtari 2025, arXiv:2502.03279 (posterior SBC);
    Cook, Gelman & Rubin, J. Comp. Graph. Stat. 2006 (the chi-square of ranks).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from scipy.stats import chi2, norm
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.diagnostics.calibration import Judged, Verdict, worst
from sbi_active.diagnostics.check import is_campaign
from sbi_active.diagnostics.log_score import smooth
from sbi_active.expected import require, suggests
from sbi_active.inference.beliefs.belief import names_of
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.refining import refine
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

#: From actions (t, action_dim), outcomes (t, *x_shape) and a seed to a belief.
Infer = Callable[[Tensor, Tensor, int], Distribution]


@dataclass(frozen=True, kw_only=True, repr=False)
class BeliefCheck(Judged):
    """Whether a refined belief can be trusted.

    Attributes:
        verdict: "trust"; "refine" where the belief is not that of a second inference,
            or ranks are not uniform; "stop" where it excludes what others hold or is
            too narrow.
        reasons: Reasons for the verdict, a sentence each.
        parameter_names: Names of the parameters; the last of the figures is the joint
            density.
        refits: Nats by which each refit, at its own draws, exceeds the belief, which is
            too narrow or elsewhere; and nats at the belief's draws, likewise, where it
            is too wide or elsewhere.
        spread: Standard deviation of the normal scores of the ranks, one a parameter
            and one for the density: 1 where right, more for too narrow.
        p_value: p-value of spread and mean of the scores, one as for ``spread``.
        num_repeats: Repeats of posterior SBC.
        num_simulations: Rows of new outcomes.
    """

    refits: tuple[tuple[float, float], ...]
    spread: tuple[float, ...]
    p_value: tuple[float, ...]
    num_repeats: int
    num_simulations: int

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {self.num_repeats} repeats around the belief"]
        lines += [f"- {reason}" for reason in self.reasons]
        if self.refits:
            texts = [f"{a:.2f} and {b:.2f}" for a, b in self.refits]
            lines.append(f"  refits differ by {'; '.join(texts)} nats")
        names = *self.parameter_names, "density"
        for name, spread, p in zip(names, self.spread, self.p_value, strict=False):
            lines.append(f"  {name}: scores spread {spread:.2f}, p = {p:.2g}")
        return "\n".join(lines)


@suggests
def check_belief(
    inference: Any,
    simulator: Callable[..., Any] | None = None,
    *,
    num_repeats: int = 40,
    num_copies: int = 6,
    num_refits: int = 2,
    num_posterior_samples: int = 200,
    refinement: RefinementOptions | None = None,
    infer: Infer | None = None,
    level: float = 0.02,
    seed: int = 0,
) -> BeliefCheck:
    """Return whether a refined belief is right, by refits and posterior SBC.

    Each repeat costs an inference; with ``num_repeats=0`` only the refits are made,
    which find most accidents at the price of two.

    Args:
        inference: A trainer or a campaign after at least one trial.
        simulator: Simulator of new outcomes; None takes the campaign's.
        num_repeats: Inferences of simulated trials; 0, or at least 10.
        num_copies: New outcomes of each executed action in a repeat.
        num_refits: Inferences of the same trials with other seeds.
        num_posterior_samples: Draws that a repeat's parameters are ranked among.
        refinement: Options of the refits; None takes the campaign's settings, or the
            defaults.
        infer: ``infer(action, x, seed)`` gives a belief; None refines.
        level: Probability that ranks alone flag a right belief, at most.
        seed: Seed of all draws.

    Raises:
        ValueError: If there is no trial, no simulator, or sizes are too small.
    """
    require(
        num_copies >= 1 and (num_repeats >= 10 or (num_repeats == 0 < num_refits)),
        "num_copies and num_repeats at least 1 and 10, or refits alone",
        f"{num_copies}, {num_repeats} and {num_refits} refits",
        "use 6, 40 and 2",
    )
    if is_campaign(inference):
        prior, trials = inference.prior, inference.state.explained
        simulator = inference.simulator if simulator is None else simulator
        own = inference.state.options.refinement
        refinement = own if refinement is None else refinement
    else:
        prior, trials = inference._prior, inference.trials
    require(
        simulator is not None and len(trials) > 0,
        "a simulator and at least one trial",
        f"{simulator} and {len(trials)} trials",
        "pass simulator, and check a belief after its first update",
    )
    belief, model = inference.belief, cast(Any, simulator)
    action, x = (torch.stack([getattr(t, k) for t in trials]) for k in ("action", "x"))

    def refined(action: Tensor, x: Tensor, seed: int) -> Distribution:
        return refine(model, prior, action, x, settings=refinement, seed=seed)

    infer = refined if infer is None else infer
    refits = [
        _compare(belief, infer(action, x, derive_seed(seed, "refit", r)), seed)
        for r in range(num_refits)
    ]
    sizes = num_repeats, num_copies, num_posterior_samples
    scores = _scores(*(belief, model, infer, action, x), sizes=sizes, seed=seed)
    dim = belief.event_shape[0]
    names = getattr(simulator, "parameter_names", None) or names_of(belief, dim)
    return _judge((*names,), refits, scores, level, len(x) * num_copies * num_repeats)


def _compare(
    belief: Distribution,
    other: Distribution,
    seed: int,
    *,
    num_compared: int = 1_000,
    deepest: float = 12.0,
) -> tuple[float, float]:
    """Return E[log other - log belief] at the other's draws, and the reverse.

    Args:
        belief: Belief to be judged.
        other: Refit.
        seed: Seed of the draws.
        num_compared: Draws behind each divergence.
        deepest: Nats that one draw may count.
    """
    with forked_generators(derive_seed(seed, "compare")):
        there = other.sample(torch.Size([num_compared])).float()
        here = belief.sample(torch.Size([num_compared])).float()

    def excess(a: Distribution, b: Distribution, theta: Tensor) -> float:
        gap = (smooth(a, theta) - smooth(b, theta)).nan_to_num(nan=0.0, posinf=deepest)
        return float(gap.clamp(-deepest, deepest).mean())

    return excess(other, belief, there), excess(belief, other, here)


def _scores(
    belief: Distribution,
    simulator: Callable[..., Any],
    infer: Infer,
    action: Tensor,
    x: Tensor,
    *,
    sizes: tuple[int, int, int],
    seed: int,
) -> np.ndarray:
    """Return normal scores of the ranks of parameters and density, (repeats, d + 1)."""
    num, copies, num_draws = sizes
    with forked_generators(derive_seed(seed, "truths")):
        truths = belief.sample(torch.Size([num])).float()
    new = action.repeat(copies, 1)
    scores = []
    for k, theta in enumerate(truths):
        own = derive_seed(seed, "new", k)
        rows = simulate(simulator, theta.expand(len(new), -1), new, seed=own)
        rows = rows.without_missing()
        every = torch.cat([action, rows.action.to(action)])
        seen = torch.cat([x, rows.x.to(x)])
        after = infer(every, seen, derive_seed(seed, "repeat", k))
        with forked_generators(derive_seed(seed, "rank", k)):
            draws = after.sample(torch.Size([num_draws])).float()
            ties = np.random.random(len(theta) + 1)
        values = torch.cat([draws, smooth(after, draws)[:, None]], 1).double()
        own = torch.cat([theta, smooth(after, theta[None])]).double()
        below = (values < own).sum(0).numpy() + ties * (values == own).sum(0).numpy()
        scores.append(norm.ppf((below + 0.5) / (num_draws + 1)))
    return np.array(scores).reshape(num, -1 if num else 0)


def _judge(
    names: tuple[str, ...],
    refits: Sequence[tuple[float, float]],
    scores: np.ndarray,
    level: float,
    num_simulations: int,
    *,
    different: float = 0.3,
    excluded: float = 0.6,
) -> BeliefCheck:
    """Return what refits and ranks say of a belief.

    Args:
        names: Names of the parameters.
        refits: Nats beyond and within it, of each refit.
        scores: Normal scores of the ranks, shape (n, d + 1), or (0, 0).
        level: Probability that ranks alone flag a right belief.
        num_simulations: Rows of new outcomes.
        different: Nats a parameter at which two beliefs differ; twice the width is .8
            or .3 by the direction.
        excluded: Nats a parameter of refits that the belief does not hold.
    """
    dim, n = len(names), len(scores)
    found: list[tuple[Verdict, str]] = []
    if refits:
        a, b = min(refits, key=max)
        text = (
            f"inferred again it is another: {a:.2f} nats are beyond it, {b:.2f} in it"
        )
        if a > excluded * dim:
            found.append(("stop", f"{text}; it is too narrow or lost a mode"))
        elif max(a, b) > different * dim:
            found.append(("refine", f"{text}; raise num_histories"))
        elif max(map(max, refits)) > 2 * different * dim:
            text = "two inferences of the same trials differ; raise num_histories"
            found.append(("refine", text))
    is_other = bool(found)
    total, shift = (scores**2).sum(0), scores.sum(0) / max(n, 1)
    tail = np.minimum(2 * np.minimum(chi2.sf(total, n), chi2.cdf(total, n)), 1.0)
    side = 2 * norm.sf(np.abs(shift) * n**0.5)
    p_value = np.minimum(2 * np.minimum(tail, side), 1.0)
    spread = (total / max(n, 1)) ** 0.5
    labels = (*names, "the density")
    for k in np.flatnonzero(p_value < level / (dim + 1)):
        text = f"ranks of {labels[k]} in repeats are not uniform (p = {p_value[k]:.1g})"
        # The truth of a wide belief lies where the density is high.
        is_wide = shift[k] > 0 if k == dim else spread[k] < 1
        if is_other:  # of the belief and the repeats, which is wrong?
            found.append(("refine", text))
        else:
            text += f": beliefs are too {'wide' if is_wide else 'narrow'} or misplaced"
            found.append(("refine" if is_wide else "stop", text))
    return BeliefCheck(
        verdict=worst([v for v, _ in found]),
        reasons=(*(text for _, text in found),),
        parameter_names=names,
        refits=(*refits,),
        spread=(*spread.tolist(),),
        p_value=(*p_value.tolist(),),
        num_repeats=n,
        num_simulations=num_simulations,
    )
