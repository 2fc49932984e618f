"""From trajectories to a belief about the parameters, in one call."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.criticism.checks import lacks_noise, require_fitting
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.identification.fitting import Fitted, fitted
from sbi_active.criticism.identification.settings import IdentifySettings
from sbi_active.criticism.identification.widening import (
    bends,
    opened,
    reflected,
    sampled,
    shared,
    spread,
)
from sbi_active.expected import require, suggests
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.beliefs.weighted import KernelBelief
from sbi_active.inference.sampling.weights import scott
from sbi_active.seeding import derive_seed
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.threads import single_thread


class IdentifiedBelief(KernelBelief):
    """A belief by draws of a linearized posterior.

    Attributes:
        draws: Draws of theta, shape (n, theta_dim).
        sides: Bound of the prior at which each parameter lies, -1 for the lower one, 1
            for the upper one, 0 for none, shape (theta_dim,).
    """

    label = "identified"

    def __init__(self, prior: Distribution, draws: torch.Tensor) -> None:
        width = scott(*draws.shape)
        mean = draws.mean(0)
        # Kernels widen what they stand on: draws move in by as much.
        super().__init__(prior, mean + (1 - width**2) ** 0.5 * (draws - mean))
        self.draws = draws
        self.sides = np.zeros(draws.shape[1], dtype=np.int64)

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the central interval of each parameter by its name.

        The interval of a parameter at a bound of its prior is one-sided, from the bound
        on.

        Args:
            level: Probability of the interval.
        """
        require(0 < level < 1, "a level between 0 and 1", level, "pass a probability")
        assert self.parameter_names is not None
        below, draws = (1 - level) * (1 + self.sides) / 2, self.draws.double().numpy()
        ends = [
            np.quantile(own, [low, low + level]).tolist()
            for own, low in zip(draws.T, below, strict=True)
        ]
        return dict(zip(self.parameter_names, map(tuple, ends), strict=True))


@suggests
@single_thread()
def identify(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    beside: Sequence[Effect] = (),
    seed: int = 0,
    settings: IdentifySettings = IdentifySettings(),  # noqa: B008  (frozen)
) -> IdentifiedBelief:
    r"""Return the belief of trajectories over the parameters, with valid intervals.

    The best fit is found by least squares, and the model is linear around it. Errors
    of each channel may be white or last, for an unknown time and in an unknown size
    (:mod:`..linear.processes`). Effects ``beside`` may be there or not, each with its
    own parameter (:mod:`.posterior`); fits follow where they are. Where single trials
    disagree all the same, the model lacks something else, and the belief is as wide as
    their disagreement says (:mod:`.widening`). Where the likelihood is not that of a
    linear model, draws are of the simulator's own.

    Args:
        model: Simulator, deterministic but for the noise. The white part of the errors
            has the size that a ``GaussianNoise`` declares; any other noise, or none,
            leaves sizes to the trials, one a channel.
        prior: Prior of its parameters.
        trials: Trajectories, with gaps where nothing was measured.
        beside: Effects that the model may lack. Those of scope "trial" are there, with
            a nuisance in each trial.
        seed: Seed of all draws.
        settings: Settings of what is spent, and of what decides.

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
    some, own, seed = trials.fit, settings, derive_seed(seed, "identify")
    if int(some.valid.sum()) > 1:  # a single log is as good, if it is long
        require_fitting(model, prior, trials, (), None)
    found = fitted(model, prior, some, beside, known_sd, seed, own)
    rng = np.random.default_rng(derive_seed(seed, "draws"))
    u, effective, shape = _sampled(found, rng, own)
    parts, c = spread(found, own.fewest_parts), found.rival.coordinates
    u = (found.origin + u)[:, : found.rival.theta_dim]
    low, high = c.low[: u.shape[1]], c.high[: u.shape[1]]
    least = float(parts.p_value.min(initial=1.0))
    disagree = least * len(parts.p_value) < own.level
    if disagree:
        weight = own.wider * rng.standard_normal((len(u), len(parts.deviation)))
        u = reflected(u + weight @ parts.deviation, low, high)
    ratio, alike = shared(found)
    if alike < own.level:
        extra = rng.permutation(found.draws.u[:, : u.shape[1]])
        wider = u + (ratio - 1) ** 0.5 * (extra - extra.mean(0))
        u = reflected(wider, low, high)
    names = model.parameter_names or [f"theta_{k + 1}" for k in range(u.shape[1])]
    sides = c.sides(u)
    for k in np.flatnonzero(sides):
        bound = (low if sides[k] < 0 else high)[k]
        inside = opened(sides[k] * (bound - u[:, k]), parts.sd[k], own.half)
        u[:, k] = bound - sides[k] * inside
    rest = np.broadcast_to(found.origin[u.shape[1] :], (len(u), c.dim - u.shape[1]))
    theta = c.to_z(np.concatenate([np.clip(u, low, high), rest], 1))[:, : u.shape[1]]
    belief = IdentifiedBelief(prior, torch.from_numpy(theta))
    belief.parameter_names = (*names,)
    belief.sides = sides
    notes: list[str] = []
    if disagree:
        worst = names[int(np.argmin(parts.p_value))]
        notes.append(
            f"SA123 single trials disagree about {worst} (p = {least:.1g}): the model "
            "lacks something, and intervals are as wide as they disagree; ask "
            "close_loop what it lacks"
        )
    if alike < own.level:
        notes.append(
            f"SA123 trials share their errors (p = {alike:.1g}): the model lacks "
            f"something, and intervals are {ratio**0.5:.2g} times as wide as if they "
            "did not; ask close_loop what it lacks"
        )
    dim = len(names)
    fewest = max(own.fewest, own.fewest_each * dim * (dim + 3))
    if shape is not None and (effective < fewest or shape > own.largest_shape):
        notes.append(
            f"SA115 {effective:.0f} effective draws: the posterior is not that of a "
            "nearly linear model; use Campaign, or a narrower prior"
        )
    notes += _at_bounds(belief)
    errors, present = _errors(found, model), found.draws.present.mean(0).tolist()
    if known_sd is not None:
        notes += _beyond(found, errors, known_sd, own.beyond)
    belief.diagnostics = (
        Diagnostics(trustworthy=True)
        .warned(*notes)
        .extended(
            num_simulations=found.rival.simulator.num_simulations,
            effective_sample_size=effective,
            beside=dict(zip([e.name for e in found.effects], present, strict=True)),
            aliases=found.aliases,
            errors=errors,
            disagreement=dict(zip(names, parts.p_value.tolist(), strict=True)),
            is_linear=shape is None,
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
        is_mean = lacks_noise(model, prior, trials)
        advice = "use Campaign, which learns what it returns, or declare noise="
        require(is_mean, "a deterministic simulator", "a random one", advice)
        model = copy.copy(model)
        model.noise = GaussianNoise(1.0)
        return model, None
    if not isinstance(noise, GaussianNoise) or noise.posterior is not None:
        return model, None
    sd = np.broadcast_to(np.asarray(noise.sd, dtype=float).reshape(-1), (num,))
    got = ", ".join(f"{value:g}" for value in sd)  # errors are told in its units
    advice = "declare the sensor's standard deviation, or pass a model without noise, "
    advice += "whose size is then found with the rest"
    require(bool((sd > 0).all()), "an error above 0 in each channel", got, advice)
    return model, sd


def _sampled(
    found: Fitted, rng: np.random.Generator, settings: IdentifySettings
) -> tuple[Array, float, float | None]:
    """Return draws of u - origin, how many they count for, and their weights' tail.

    Its shape is None if the model is linear. If it bends, draws of the likeliest set of
    effects are the simulator's; of the others' a chord may be all that is known.
    """
    own, draws = settings, found.draws
    sets, place = np.unique(draws.present, axis=0, return_inverse=True)
    best = int(np.bincount(place).argmax())
    at = rng.permutation(np.flatnonzero(place == best))
    if not len(found.others) and not bends(found, at[: own.num_compared], own.linear):
        return draws.u.copy(), float(len(draws.u)), None
    fit, u = sampled(found, sets[best], rng, own.most_simulated), draws.u.copy()
    # Few draws would make for a narrow interval: rather that of the linear model.
    if fit.effective_sample_size >= own.fewest:
        free = found.free(sets[best].nonzero()[0])
        u[np.ix_(at, free)] = fit.draws(len(at), rng) - found.origin[free]
    return u, fit.effective_sample_size, fit.tail_shape


def _errors(found: Fitted, model: SimulatorModel) -> dict[str, dict[str, float]]:
    """Return the likeliest errors of each channel."""
    known, names, said = found.errors.processes, model.channel_names, {}
    each = zip(*found.errors.likeliest(found.draws.u.mean(0)), strict=True)
    for c, (h, variance) in enumerate(each):
        said[names[c] if names else f"channel {c}"] = {
            "sd": float(found.sizes[c] * variance**0.5),
            "white": float(known.white[h]),
            "time": float(known.time[h] if h > 0 else 0.0),
        }
    return said


def _beyond(
    found: Fitted, errors: dict[str, dict[str, float]], declared: Array, times: float
) -> list[str]:
    """Return in which channels residuals are far larger than the declared error."""
    # What is left, since shapes of the error only have sizes some steps apart.
    ratio = found.sizes / declared
    return [
        f"SA124 residuals of {name} are {ratio[c]:.2g} times the declared error: the "
        "model lacks something, or the error is declared too small; ask close_loop "
        "what it lacks"
        for c, (name, own) in enumerate(errors.items())
        if own["sd"] > times * declared[c]
    ]


def _at_bounds(belief: IdentifiedBelief) -> list[str]:
    """Return the parameters that may be beyond a bound of the prior."""
    limits = {-1: "lower one: at most {1:.3g}", 1: "upper one: at least {0:.3g}"}
    each = zip(belief.interval().items(), belief.sides.tolist(), strict=True)
    return [
        f"SA103 {name} is at a bound of its prior, the {limits[side].format(*ends)}, "
        "and nothing says how far beyond; move the bound, or say why"
        for (name, ends), side in each
        if side
    ]
