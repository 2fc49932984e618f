r"""Few numbers in place of many: projections in which the rivals differ.

For images and the like. With s the declared standard deviation of the noise and
:math:`y = x / s`, the summaries are :math:`W (y - \bar y)` with orthonormal rows: half
of them at most are principal components of what the simulator's parameters change, the
rest of what the effects change beyond these, each effect counting as much as any other.
Independent noise of x is independent noise of unit size in the summaries, and whatever
is said with them is said given them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel

#: Numbers a trial beyond which summaries are taken unless they are refused.
MANY = 500
#: Summaries at most.
MOST = 20
NUM_SIMULATIONS = 1_000


@dataclass(frozen=True)
class Summarized:
    """A comparison of models given summaries.

    Attributes:
        model: Simulator of the summaries, with noise of unit size.
        trials: Trials, with their summaries as x.
        effects: Effects as declared, acting on x before it is summarized.
        weight: W / s, shape (k, numbers of x).
    """

    model: SimulatorModel
    trials: Trials
    effects: list[Effect]
    weight: Tensor


@dataclass(frozen=True)
class _Observed:
    """Changes of x before it is summarized."""

    steps: tuple[tuple[Effect, Tensor, Tensor, Context], ...] = ()


def summarize(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    effects: Sequence[Effect],
    *,
    num: int = MOST,
    seed: int = 0,
) -> Summarized:
    """Return the models and trials in terms of at most ``num`` summaries.

    Args:
        model: The bare simulator.
        prior: Prior of its parameters.
        trials: Trials with many numbers each, all or none of them measured.
        effects: Declared effects.
        num: Summaries at most.
        seed: Seed of the simulations that they are trained on.

    Raises:
        ValueError: If the noise is not independent and Gaussian, numbers are masked,
            or an effect changes the noise.
    """
    reason = obstacle(model, trials, effects)
    if reason:
        raise ValueError(
            "expected whole observations with independent Gaussian noise for "
            f"summaries; got {reason}; set summaries=0, which compares all numbers"
        )
    x = trials.x.flatten(1)
    base = model.base if isinstance(model, AugmentedSimulator) else model
    assert model.noise is not None
    sd = model.noise.declared_sds()
    sd = sd.repeat(x.shape[1] // len(sd))
    weight, center = _trained(model, prior, trials, effects, sd, num, seed)

    def fn(
        theta: Tensor,
        action: Tensor,
        *,
        seeds: Tensor | None = None,
        observed: _Observed = _Observed(),  # noqa: B008  (frozen)
        **keywords: Any,
    ) -> Tensor:
        x = base._run(theta, action, seeds, keywords)
        for effect, phi, commanded, context in observed.steps:
            x = effect.apply(x, phi, commanded, context)
        return (x.flatten(1).to(weight) - center) @ weight.T

    short = SimulatorModel(
        fn, noise=GaussianNoise(1.0), parameter_names=base.parameter_names
    )
    if isinstance(model, AugmentedSimulator):
        own = [_before_summary(e) for e in model.effects]
        short = AugmentedSimulator(short, own, next_index=model.next_index)
    own = trials.select(slice(None))
    own.x, own.channel_labels = (x - center) @ weight.T, None
    return Summarized(short, own, [_before_summary(e) for e in effects], weight)


def obstacle(model: SimulatorModel, trials: Trials, effects: Sequence[Effect]) -> str:
    """Return the obstacle to summaries, in words; "" for none."""
    reason = ""
    if not isinstance(model.noise, GaussianNoise):
        reason = f"noise {model.noise}"
    elif trials.sample_times is not None or model.sample_times is not None:
        reason = "a time axis, along which errors may be correlated"
    elif trials.inputs is not None or trials.start is not None:
        reason = "inputs over time or start states"
    elif bool((trials.mask.flatten(1).any(1) != trials.mask.flatten(1).all(1)).any()):
        reason = "numbers that are masked"
    elif any(e.hook == "noise" for e in effects):
        reason = "an effect on the noise"
    return reason


def _before_summary(effect: Effect) -> Effect:
    """Return an effect on x as one on what is done before x is summarized."""
    if effect.hook != "observation":
        return effect

    def apply(
        value: dict[str, Any], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Any]:
        before = value.get("observed", _Observed()).steps
        this = (effect, phi, action, context)
        return {**value, "observed": _Observed((*before, this))}

    return replace(effect, hook="dynamics", apply=apply)


def _trained(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    effects: Sequence[Effect],
    sd: Tensor,
    num: int,
    seed: int,
) -> tuple[Tensor, Tensor]:
    """Return W / s, shape (k, N), and the center of x, shape (N,)."""
    known = model.effects if isinstance(model, AugmentedSimulator) else []
    full = AugmentedSimulator(model, effects)
    rng = np.random.default_rng(seed)
    with forked_generators(seed, "summaries"):
        parameters = prior.sample(torch.Size([NUM_SIMULATIONS]))
        draws = {e.name: e.sample(NUM_SIMULATIONS) for e in effects}
        fixed = {e.name: e.sample(NUM_SIMULATIONS) for e in known}
    theta = parameters
    if isinstance(model, AugmentedSimulator):
        theta, campaign = model.split(parameters)
        fixed |= campaign
    row = torch.as_tensor(rng.integers(len(trials), size=NUM_SIMULATIONS))
    action, index = trials.action[row].to(theta.dtype), trials.index[row]

    def simulated(some: dict[str, Tensor]) -> Tensor:
        every = {k: v.to(theta.dtype) for k, v in (fixed | some).items()}
        x = full.evaluate(theta, every, action, index=index).flatten(1).double()
        if x.shape[1] != len(sd):
            raise ValueError(
                f"expected trials of the simulator's {x.shape[1]} numbers; got "
                f"{len(sd)}; measure what the simulator returns"
            )
        return x / sd

    bare = simulated({})
    valid = bare.isfinite().all(1)
    center = bare[valid].mean(0)
    rows = _components(bare[valid] - center, num - num // 2 if effects else num)
    changes = []
    for effect in effects:
        change = simulated({effect.name: draws[effect.name]}) - bare
        change = change[change.isfinite().all(1)]
        change = change - (change @ rows.T) @ rows
        changes.append(change / change.square().sum(1).mean().sqrt().clamp_min(1e-12))
    if changes:
        rows = torch.cat([rows, _components(torch.cat(changes), num - len(rows))])
    return torch.linalg.qr(rows.T).Q.T / sd, center * sd


def _components(y: Tensor, num: int) -> Tensor:
    """Return principal directions, shape (k, N), of all variance but 1e-4."""
    _, size, rows = torch.linalg.svd(y, full_matrices=False)
    share = 1 - size.square().cumsum(0) / size.square().sum().clamp_min(1e-300)
    enough = int((share > 1e-4).sum()) + 1
    return rows[: min(num, enough)]
