"""From trajectories to a belief about the parameters, in one call."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.criticism.checks import require_fitting
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.trial_conditions import conditions_for
from sbi_active.criticism.identification.errors import whitened
from sbi_active.criticism.identification.fitting import Fitted, fitted
from sbi_active.criticism.identification.spread import spread
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.beliefs.kernel_belief import KernelBelief
from sbi_active.inference.sampling.weights import effective_sample_size, normalized
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel

Array = NDArray[Any]

#: Draws at which the linear model is compared with the simulator, the deviation of the
#: log density ratio up to which it will do, nats, and the draws that are weighed
#: where it will not.
NUM_CHECKED, LINEAR, NUM_WEIGHED = 16, 0.5, 400
#: Effective draws below which a belief is not to be trusted, and those that weights
#: leave at least.
FEWEST, FEWEST_KEPT = 50, 100
#: From a bound, in deviations of the prior.
INSIDE = 1e-6
#: Multiple of the declared deviation from which errors are no longer the sensor's.
BEYOND = 3.0


class IdentifiedBelief(KernelBelief):
    """A belief by draws of a linearized posterior.

    Attributes:
        draws: Of theta, shape (n, theta_dim).
    """

    label = "identified"

    def __init__(self, prior: Distribution, draws: torch.Tensor) -> None:
        width = len(draws) ** (-1 / (draws.shape[1] + 4))
        mean = draws.mean(0)
        # Kernels widen what they stand on: draws move in by as much.
        super().__init__(prior, mean + (1 - width**2) ** 0.5 * (draws - mean))
        self.draws = draws

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the central interval of each parameter by its name.

        Args:
            level: Its probability.
        """
        if not 0 < level < 1:
            raise ValueError(
                f"expected a level between 0 and 1; got {level}; pass a probability"
            )
        tails = torch.tensor([0.5 - level / 2, 0.5 + level / 2], dtype=torch.float64)
        ends = torch.quantile(self.draws.double(), tails, dim=0).T.tolist()
        assert self.parameter_names is not None
        each = zip(self.parameter_names, ends, strict=True)
        return {name: (low, high) for name, (low, high) in each}


def identify(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    beside: Sequence[Effect] = (),
    seed: int = 0,
) -> IdentifiedBelief:
    r"""Return what trajectories tell of the parameters, with intervals that hold.

    The best fit is found by least squares, and the model is linear around it. Errors
    of each channel may be white or last, for a time and in a size that nobody knows
    (:mod:`.errors`). Effects ``beside`` may be there or not, each with its own
    parameter (:mod:`.posterior`); fits follow where they are. Where single trials
    disagree all the same, the model lacks something else, and the belief is as wide as
    their disagreement says (:mod:`.spread`). Where the likelihood is not that of a
    linear model, draws are weighed by the simulator.

    Args:
        model: Deterministic but for the noise. The white part of the errors has the
            size that a ``GaussianNoise`` declares; any other noise, or none, leaves
            sizes to the trials, one a channel.
        prior: Of its parameters.
        trials: Trajectories, with gaps where nothing was measured.
        beside: What the model may lack. Those of scope "trial" are there, with a
            nuisance in each trial.
        seed: Of all draws.

    Returns:
        A belief with ``interval(level)`` by parameter. Its ``diagnostics`` have
        ``beside``, the probability of each effect; ``errors``, by channel, their
        deviation, the share of it that is white and how long the rest lasts;
        ``aliases``, effects that are left out as parameters do the same;
        ``disagreement``, the tail probability of each parameter being the same in all
        trials.

    Raises:
        ValueError: If x has no time axis, the simulator is random, or an error is
            declared that is 0.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> t = torch.arange(100) / 50
        >>> model = SimulatorModel(
        ...     lambda theta, xi: xi * torch.exp(-theta * t), sample_times=t
        ... )
        >>> action = torch.tensor([[1.0], [2.0]])
        >>> x = action * torch.exp(-0.8 * t) + 0.01 * torch.randn(2, 100)
        >>> prior = BoxUniform(torch.zeros(1), torch.full((1,), 3.0))
        >>> belief = identify(model, prior, Trials(action, x))
        >>> {k: round(low, 1) for k, (low, _) in belief.interval().items()}
        {'theta_1': 0.8}
    """
    model, known_sd = _with_noise(model, prior, trials)
    some = trials.fit
    if int(some.valid.sum()) > 1:  # a single log is as good, if it is long
        require_fitting(model, prior, trials, (), None)
    seed = derive_seed(seed, "identify")
    found = fitted(model, prior, some, beside, known_sd=known_sd, seed=seed)
    rng = np.random.default_rng(derive_seed(seed, "draws"))
    own = found.rival.theta_dim
    u, effective, is_linear = _weighed(found, rng)
    parts = spread(found)
    notes = []
    c = found.rival.coordinates
    if parts.disagree:
        theta = parts.widen(found.u[:own] + u[:, :own], rng)
        u[:, :own] = _reflected(theta, c.low[:own], c.high[:own]) - found.u[:own]
    names = model.parameter_names or [f"theta_{k + 1}" for k in range(own)]
    theta = c.to_z(np.clip(found.u + u, c.low, c.high))[:, :own]
    belief = IdentifiedBelief(prior, torch.from_numpy(theta))
    belief.parameter_names = (*names,)
    if parts.disagree:
        worst = names[int(np.argmin(parts.p_value))]
        notes.append(
            f"single trials disagree about {worst} (p = {parts.p_value.min():.1g}): "
            "the model lacks something, and intervals are as wide as they disagree; "
            "ask close_loop what it lacks"
        )
    if effective < FEWEST:
        notes.append(
            f"{effective:.0f} effective draws: the posterior is not that of a nearly "
            "linear model; use Campaign, or a narrower prior"
        )
    notes += _at_bounds(found, u, names)
    errors = _errors(found, model)
    if known_sd is not None:
        notes += _beyond(errors, known_sd)
    belief.diagnostics = (
        Diagnostics(trustworthy=True)
        .warned(*notes)
        .extended(
            num_simulations=found.rival.simulator.num_simulations,
            effective_sample_size=effective,
            beside=_beside(found),
            aliases=found.aliases,
            errors=errors,
            disagreement=dict(zip(names, parts.p_value.tolist(), strict=True)),
            is_linear=is_linear,
        )
    )
    return belief


def _with_noise(
    model: SimulatorModel, prior: Distribution, trials: Trials
) -> tuple[SimulatorModel, Array | None]:
    """Return a model that is no draw, and the declared size of white errors (c,)."""
    noise = model.noise
    num = int(np.prod(trials.x.shape[2:]))
    if noise is None:
        with forked_generators(0, "random"):
            theta = prior.sample(torch.Size([len(trials)]))
        run = conditions_for(model, trials, torch.arange(len(trials)), theta.dtype)
        action = trials.action.to(theta.dtype)
        if not model.is_deterministic(theta, action, **run):
            raise ValueError(
                "expected a deterministic simulator; got a random one; use Campaign, "
                "which learns what it returns, or fix its seed and declare noise="
            )
        model = copy.copy(model)
        model.noise = GaussianNoise(1.0)
        return model, None
    if not isinstance(noise, GaussianNoise) or noise.posterior is not None:
        return model, None
    sd = np.broadcast_to(np.asarray(noise.sd, dtype=float).reshape(-1), (num,))
    if not (sd > 0).all():  # errors are told in its units
        got = ", ".join(f"{value:g}" for value in sd)
        raise ValueError(
            f"expected an error above 0 in each channel; got {got}; declare the "
            "sensor's standard deviation, or pass a model without noise, whose size "
            "is then found with the rest"
        )
    return model, sd


def _weighed(found: Fitted, rng: np.random.Generator) -> tuple[Array, float, bool]:
    """Return draws of u - found.u, how many they count for, and if it is linear."""
    every = found.draws.u
    order = rng.permutation(len(every))
    log_w = _log_ratio(found, order[:NUM_CHECKED])
    if log_w.std() < LINEAR:
        return every.copy(), float(len(every)), True
    some = order[:NUM_WEIGHED]
    log_w = _log_ratio(found, some)
    effective = effective_sample_size(log_w)
    # Few draws would make for a narrow interval: rather that of the linear model.
    power = 1.0
    while effective_sample_size(power * log_w) < FEWEST_KEPT:
        power *= 0.8
    picked = rng.choice(len(some), size=len(every), p=normalized(power * log_w))
    return every[some[picked]].copy(), effective, False


def _log_ratio(found: Fitted, at: Array) -> Array:
    """Return the log density of draws beside that of the linear model, (k,)."""
    m, draws = found.rival.simulator.measurements, found.draws
    u = draws.u[at]
    true = found.rival.residual(found.u + u)[0] / found.unit
    linear = found.rows[:, 0] + u @ found.rows[:, 1:].T
    chosen = np.array([np.bincount(h).argmax() for h in draws.errors.T])
    both = whitened(np.concatenate([true, linear]).T, m, found.hypotheses, chosen)
    size = np.median(draws.size, 0)[m.channel]
    square = ((both / size[:, None]) ** 2).sum(0)
    p, c = found.unknowns, found.rival.coordinates
    gaussian = -0.5 * (p.precision * (u - p.center) ** 2).sum(1)
    # At a bound, where absent effects stand, rounding would be outside.
    inside = np.clip(found.u + u, c.low + INSIDE, c.high - INSIDE)
    log_w = c.log_prob(inside) - gaussian
    log_w = log_w + 0.5 * (square[len(at) :] - square[: len(at)])
    return np.nan_to_num(log_w, nan=-1e9, neginf=-1e9, posinf=-1e9)


def _reflected(u: Array, low: Array, high: Array) -> Array:
    """Return draws that left the bounds as far inside of them."""
    u = np.where(u < low, 2 * low - u, u)
    u = np.where(u > high, 2 * high - u, u)
    return np.clip(u, low, high)


def _beside(found: Fitted) -> dict[str, float]:
    share = found.draws.present.mean(0).tolist()
    return {e.name: p for e, p in zip(found.rival.effects, share, strict=True)}


def _errors(found: Fitted, model: SimulatorModel) -> dict[str, dict[str, float]]:
    """Return what the errors of each channel are like, posterior medians."""
    m, draws, known = found.rival.simulator.measurements, found.draws, found.hypotheses
    channels = int(m.channel.max()) + 1
    names = model.channel_names or [f"channel {c}" for c in range(channels)]
    said = {}
    for c in range(channels):
        unit = float(found.unit[m.channel == c][0])
        h = draws.errors[:, c]
        said[names[c]] = {
            "sd": unit * float(np.median(draws.size[:, c])),
            "white": float(np.median(known.share[h])),
            "time": float(np.median(np.where(h > 0, known.time[h], 0.0))),
        }
    return said


def _beyond(errors: dict[str, dict[str, float]], declared: Array) -> list[str]:
    """Return in which channels residuals are far larger than the declared error."""
    ratios = {
        name: own["sd"] / sd
        for (name, own), sd in zip(errors.items(), declared.tolist(), strict=True)
    }
    return [
        f"residuals of {name} are {ratio:.0f} times the declared error: the model "
        "lacks something, or the error is declared too small; ask close_loop what it "
        "lacks"
        for name, ratio in ratios.items()
        if ratio > BEYOND
    ]


def _at_bounds(found: Fitted, u: Array, names: Sequence[str]) -> list[str]:
    """Return which parameters may be beyond a bound of the prior."""
    sides = found.rival.coordinates.sides((found.u + u)[:, : len(names)])
    return [
        f"{name} is at a bound of its prior; move the bound, or say why"
        for name, side in zip(names, sides, strict=True)
        if side
    ]
