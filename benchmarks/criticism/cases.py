r"""Draw what is wrong with reality, and hand over the trials alone.

This is the one place that knows the truth. A case has two halves: a :class:`Problem`,
which the loop sees, and a :class:`Truth`, which the scores see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations, count
from typing import Literal, get_args

import torch
from torch import Tensor

from benchmarks.criticism.problem import Problem
from benchmarks.criticism.worlds import World
from benchmarks.fitting import residual_sum_of_squares
from sbi_active.criticism import Context, Effect, Trials
from sbi_active.criticism.data import Role
from sbi_active.seeding import derive_seed, forked_generators, row_normals, row_seeds

Kind = Literal["clean", "library", "outside", "removed", "inexpressible", "pair"]
KINDS: tuple[Kind, ...] = get_args(Kind)
HELD_OUT = 8  # trials that no step may fit or choose by
#: A truth is drawn again unless so many of its first actions have an outcome.
NUM_LOOKED, FEWEST_OUTCOMES = 8, 4
MISMATCH = 3.0  # residual of a number that is there in one outcome alone
#: Lambda that a model must leave for data to tell that it lacks something.
SUPPORTED = 25.0


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What the data were made with; for scores only.

    Attributes:
        world: Where.
        kind: What was drawn.
        theta: Shape (1, theta_dim).
        effects: None, one or two.
        strengths: Of the effects, each of shape (1, phi_dim).
        correlation: Of neighboring errors.
        action: Of the trials to fit, shape (t, action_dim).
        seed: Of the noise.
    """

    world: World
    kind: Kind
    theta: Tensor
    effects: tuple[Effect, ...]
    strengths: tuple[Tensor, ...]
    correlation: float
    action: Tensor
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    def observe(self, action: Tensor, index: Tensor) -> Tensor:
        """Return what the real system does in trials.

        Args:
            action: Shape (t, action_dim).
            index: Number of each trial, shape (t,); its noise depends on it alone.

        Returns:
            Shape (t, *x_shape).
        """
        theta = self.theta.expand(len(action), -1)
        x, sd = respond(self.world, theta, action, index, self.effects, self.strengths)
        seeds = row_seeds(self.seed, int(index.max()) + 1)[index]
        normal = row_normals(seeds, x[0].numel()).reshape(x.shape)
        rho, error = self.correlation, torch.empty_like(normal)
        error[..., 0] = normal[..., 0]
        for k in range(1, x.shape[-1]):
            fresh = (1 - rho**2) ** 0.5 * normal[..., k]
            error[..., k] = rho * error[..., k - 1] + fresh if rho else normal[..., k]
        return (x + sd * error).float()

    @cached_property
    def non_centrality(self) -> float:
        r""":math:`\lambda`, what the bare model cannot take up by its parameters.

        The sum of squared residuals, in units of the noise, that is left when the bare
        model is refitted to the noise-free data.
        """
        return self._left_by(()) if self.effects else 0.0

    @cached_property
    def support(self) -> float:
        """What is left without the less needed of two effects, the other refitted."""
        return min(self._left_by((effect,)) for effect in self.effects)

    def left_by_any(self, declared: Sequence[Effect]) -> float:
        """Return what is left by the best one or two of the declared effects."""
        sets = chain(combinations(declared, 1), combinations(declared, 2))
        return min(self._left_by(effects) for effects in sets)

    def without_aliases(self, declared: Sequence[Effect]) -> list[Effect]:
        """Return the declared effects less those that could stand in for the truth.

        Out are those that alone leave too little for data to tell, and of each pair
        that does, closest first, the one that alone leaves less.
        """
        alone = {effect.name: self._left_by((effect,)) for effect in declared}
        kept = [effect for effect in declared if alone[effect.name] > SUPPORTED]
        left = {pair: self._left_by(pair) for pair in combinations(kept, 2)}
        for pair in sorted(left, key=left.__getitem__):
            if left[pair] <= SUPPORTED and all(effect in kept for effect in pair):
                kept.remove(min(pair, key=lambda effect: alone[effect.name]))
        return kept

    def residual(
        self, parameters: Tensor, effects: Sequence[Effect], target: Tensor
    ) -> Tensor:
        """Return whitened residuals of the trials to fit, in units of the noise.

        Args:
            parameters: Theta and the strengths of the effects, shape (n, dim).
            effects: What the model has.
            target: Outcomes, shape (t, *x_shape).

        Returns:
            Shape (n, m), float64.
        """
        x = self.predict(parameters, effects, self.action, 0)
        error = (x - target.double()) / self.world.noise_sd
        # An outcome where there is none, or none where there is one.
        error = error.where(x.isnan() == target.isnan(), error.new_tensor(MISMATCH))
        error = error.nan_to_num(nan=0.0)
        return whiten(error, self.correlation).flatten(1)

    def predict(
        self, parameters: Tensor, effects: Sequence[Effect], action: Tensor, first: int
    ) -> Tensor:
        """Return noise-free outcomes of trials, shape (n, t, *x_shape), float64.

        Args:
            parameters: As in :meth:`residual`.
            effects: As in :meth:`residual`.
            action: Shape (t, action_dim).
            first: Index of the first of them.
        """
        num = len(action)
        theta_dim = self.theta.shape[1]
        sizes = [theta_dim, *[effect.phi_dim for effect in effects]]
        each = parameters.double().repeat_interleave(num, 0)
        theta, *strengths = each.split(sizes, -1)
        index = torch.arange(first, first + num).repeat(len(parameters))
        rows = action.double().repeat(len(parameters), 1)
        x, _ = respond(self.world, theta, rows, index, effects, strengths)
        return x.reshape(len(parameters), num, *x.shape[1:])

    def starts(self, effects: Sequence[Effect]) -> Tensor:
        """Return draws of theta and strengths to start fits from, float64.

        Where the simulator is rough, half of theta's are near the truth.
        """
        with forked_generators(derive_seed(self.seed, "refit")):
            theta = self.world.prior.sample((64,)).double()
            if self.world.is_rough:
                near = torch.arange(len(theta)) % 2 == 0
                share = torch.logspace(-3, 0, int(near.sum()), dtype=torch.float64)
                theta[near] += (1 - share[:, None]) * (self.theta - theta[near])
            return torch.cat([theta, *[e.sample(64) for e in effects]], -1)

    def _left_by(self, effects: Sequence[Effect]) -> float:
        true = torch.cat([self.theta, *self.strengths], -1)
        target = self.predict(true, self.effects, self.action, 0)[0]
        return residual_sum_of_squares(
            lambda parameters: self.residual(parameters, effects, target),
            self.starts(effects),
            prior=self.world.prior,
            is_rough=self.world.is_rough,
        )


@dataclass(frozen=True)
class Case:
    """A problem and its truth."""

    problem: Problem
    truth: Truth


def draw_case(
    world: World,
    kind: Kind,
    number: int,
    *,
    num_trials: int = 8,
    num_held_out: int = HELD_OUT,
) -> Case:
    """Draw one case.

    The effect is uniform among those of its kind (noise inflation counts as one of the
    library), or the next of those that the world names as hidden; its strength has its
    prior, theta the prior, and actions are uniform.

    Args:
        world: Where.
        kind: "clean", "library", "outside", "removed" (of the library, and taken from
            what is declared together with its equivalents), "inexpressible" (the same
            case, where every near-alias is taken out as well, so that no one or two of
            those declared fit) or "pair" (two of the library that are not equivalent).
        number: Of the case; the same number is the same truth for any number of trials.
        num_trials: Trials to fit.
        num_held_out: Further trials, held out.

    Returns:
        The case.
    """
    drawn = "removed" if kind == "inexpressible" else kind
    seed = derive_seed(number, "case", world.name, drawn)
    truth = _draw_truth(world, drawn, number, seed, 64 + num_held_out)
    for again in count():
        if len(_some_outcome(truth, truth.action[:NUM_LOOKED])) >= FEWEST_OUTCOMES:
            break
        other = derive_seed(seed, "again", again)
        truth = _draw_truth(world, drawn, number, other, 64 + num_held_out)
    held_out, spare = truth.action[64:], truth.action[num_trials:64]
    action = truth.action[:num_trials]
    truth = replace(truth, kind=kind, action=action)
    library = [*world.effects]
    if drawn == "removed":
        gone = world.equivalent(truth.names[0])
        library = [effect for effect in library if effect.name not in gone]
    if kind == "inexpressible" and truth.non_centrality > SUPPORTED:
        library = truth.without_aliases(library)
    problem = Problem(
        model=world.model,
        prior=world.prior,
        trials=make_trials(truth, action, _with_outcome(truth, held_out, spare)),
        effects=library,
        actions=world.actions,
    )
    return Case(problem, truth)


def make_trials(truth: Truth, action: Tensor, held_out: Tensor) -> Trials:
    """Return the real system's trials: those to fit, then those held out."""
    every = torch.cat([action, held_out])
    index = torch.arange(len(every))
    roles: list[Role] = ["held out" if i >= len(action) else "fit" for i in index]
    times = truth.world.sample_times
    return Trials(
        every,
        truth.observe(every, index),
        role=roles,
        index=index,
        sample_times=torch.tensor(times) if times else None,
    )


def extend(case: Case, action: Tensor) -> Case:
    """Return the case with one more trial to fit and none held out.

    Args:
        case: The case.
        action: Of the next trial, shape (action_dim,).
    """
    grown = torch.cat([case.truth.action, action.reshape(1, -1)])
    truth = replace(case.truth, action=grown)
    trials = make_trials(truth, grown, grown[:0])
    return Case(replace(case.problem, trials=trials), truth)


def respond(
    world: World,
    theta: Tensor,
    action: Tensor,
    index: Tensor,
    effects: Sequence[Effect],
    strengths: Sequence[Tensor],
) -> tuple[Tensor, Tensor]:
    """Return the noise-free outcome and the noise's standard deviation, a row each.

    Deliberately apart from the library's own augmented simulator, so that a mistake
    there does not make the data agree with it.
    """
    context = Context(index.to(theta.dtype))
    keywords: dict[str, Tensor] = {}

    def through(hook: str, value: Tensor) -> Tensor:
        for effect, phi in zip(effects, strengths, strict=True):
            if effect.hook == hook:
                rows = phi.to(theta.dtype).expand(len(theta), -1)
                value = effect.apply(value, rows, action, context)
        return value

    for effect, phi in zip(effects, strengths, strict=True):
        if effect.hook == "dynamics":
            rows = phi.to(theta.dtype).expand(len(theta), -1)
            keywords = effect.apply(keywords, rows, action, context)
    theta = through("parameter", theta)
    x = world.model.fn(theta, through("action", action), **keywords)
    sd = through("noise", torch.full_like(x, world.noise_sd))
    return through("observation", x), sd


def whiten(error: Tensor, correlation: float) -> Tensor:
    """Return independent errors of the same variance, correlated on the last axis."""
    if not correlation:
        return error
    fresh = error[..., 1:] - correlation * error[..., :-1]
    return torch.cat([error[..., :1], fresh / (1 - correlation**2) ** 0.5], -1)


def _draw_truth(
    world: World, kind: Kind, number: int, seed: int, num_actions: int
) -> Truth:
    with forked_generators(seed):
        theta = world.prior.sample((1,))
        effects = _draw_effects(world, kind, number)
        strengths = tuple(effect.prior.sample((1,)) for effect in effects)
        which = int(torch.randint(len(world.correlations), (1,)))
        action = world.actions.sample((num_actions,))
    return Truth(
        world=world,
        kind=kind,
        theta=theta,
        effects=effects,
        strengths=strengths,
        correlation=world.correlations[which],
        action=action,
        seed=derive_seed(seed, "noise"),
    )


def _with_outcome(truth: Truth, action: Tensor, spare: Tensor) -> Tensor:
    """Return the actions, those without an outcome replaced by spare ones with one."""
    kept = _some_outcome(truth, action)
    if len(kept) == len(action):
        return action
    return torch.cat([kept, _some_outcome(truth, spare)])[: len(action)]


def _some_outcome(truth: Truth, among: Tensor) -> Tensor:
    """Return the actions that have an outcome."""
    index = torch.zeros(len(among), dtype=torch.long)
    theta = truth.theta.expand(len(among), -1)
    x, _ = respond(truth.world, theta, among, index, truth.effects, truth.strengths)
    return among[x.isfinite().flatten(1).all(1)]


def _draw_effects(world: World, kind: Kind, number: int) -> tuple[Effect, ...]:
    def one(among: Sequence[Effect]) -> Effect:
        return among[int(torch.randint(len(among), (1,)))]

    library = world.effects
    visible = [e for e in library if e.name not in world.equivalent("none")]
    if kind == "clean":
        return ()
    if kind == "outside":
        return (one(world.outside),)
    if kind == "library" and world.hidden:
        name = world.hidden[number % len(world.hidden)]
        return (next(e for e in library if e.name == name),)
    if kind == "library":
        return (one([*library, world.scatter]),)
    first = one(visible)
    if kind == "removed":
        return (first,)
    apart = [e for e in visible if e.name not in world.equivalent(first.name)]
    return (first, one(apart))
