"""The next action: what tells rivals apart, and what puts a verdict to the test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.arrays import Array, distance_from
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.trial_conditions import are_known, unmeasured
from sbi_active.criticism.results import UNEXPLAINED, ModelKey, NextAction, Tracing
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.predictive import predict
from sbi_active.design.design import Design
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.seeding import derive_seed


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Settings of the search for the next action.

    Attributes:
        max_candidates: Permitted actions at most, each predicted by every rival.
        max_outside: Actions beyond the permitted range at most.
        wider: Factors by which that range is widened about its center.
        negligible: Probability below which a rival is left out.
        max_rivals: Rivals at most.
        fewest: Probability that a model in question has at least.
        nothing: Information below which no action is worth a trial, nats.
        something: Information of another action that is worth a second choice, nats.
        samples: Outcomes of a candidate and rival, half to choose and half to report.
            Three quarters of a half fit a density, which needs some tens.
        max_tests: Candidates of a severe test beyond the permitted range.
        num_draws: Draws of each prediction in a severe test.
        max_entries: Covariances of the residual process in a severe test.
    """

    max_candidates: int = 64
    max_outside: int = 24
    wider: tuple[float, float] = (1.5, 2.0)
    negligible: float = 0.01
    max_rivals: int = 8
    fewest: float = 1e-3
    nothing: float = 0.02
    something: float = 0.1
    samples: int = 160
    max_tests: int = 16
    num_draws: int = 50
    max_entries: int = 10_000_000


PLAN = PlanSettings()


def permitted_candidates(rivals: RivalSet, actions: ActionSpace) -> Tensor:
    """Return all permitted actions, or as many at random, shape (a, action_dim)."""
    listed = actions.listed()
    if listed is not None and len(listed) <= PLAN.max_candidates:
        return listed
    seed = derive_seed(rivals.seed, "candidates")
    return actions.sample((PLAN.max_candidates,), seed=seed)


def simulated(rivals: RivalSet, candidates: Tensor) -> Tensor:
    """Return the candidates at which the bare model gives numbers.

    A simulator may fail in any way beyond the permitted range. Labels of trials have no
    such range.
    """
    if rivals.trials.action_is_label:
        return candidates[:0]
    candidates = candidates[are_known(rivals.model, rivals.trials, candidates)]
    kept = [_gives_numbers(rivals, action) for action in candidates]
    return candidates[torch.tensor(kept, dtype=torch.bool)]


@torch.no_grad()
def _gives_numbers(rivals: RivalSet, action: Tensor) -> bool:
    trial = following(rivals, action[None])
    try:
        prediction = predict(rivals, trial, num_draws=4, scored=False)
    except Exception:  # noqa: BLE001  (a user's simulator)
        return False
    return bool(np.isfinite(prediction.x).all() and prediction.valid.all())


def following(rivals: RivalSet, candidates: Tensor) -> Trials:
    """Return each candidate as if it were the next trial."""
    last = float(rivals.trials.index.max())
    index = torch.full((len(candidates),), last + 1)
    return unmeasured(rivals.model, rivals.trials, candidates, index)


def beyond_range(
    actions: ActionSpace, candidates: Tensor, *, limit: int, mirrored: bool = False
) -> Tensor:
    """Return actions beyond the range of the permitted ones, the nearest first.

    They are the permitted ones in a range widened about its center. Entries that have
    one sign keep it: a speed or a mass has no other.

    Args:
        actions: The permitted ones.
        candidates: Candidates, some or all actions, shape (a, action_dim).
        limit: Actions at most.
        mirrored: Whether the zero action and the mirror images of permitted actions, in
            each entry and in all, are among them, and any sign is.

    Returns:
        Shape (b, action_dim), b <= limit.

    Example:
        >>> from sbi_active import DiscreteActions
        >>> speeds = DiscreteActions([1.0, 2.0, 3.0])
        >>> beyond_range(speeds, speeds.values, limit=9)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0]
        >>> beyond_range(speeds, speeds.values, limit=9, mirrored=True)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0, -1.0, -2.0, -3.0]
    """
    dim = candidates.shape[1]
    low, high = candidates.min(0).values, candidates.max(0).values
    center, half = (low + high) / 2, (high - low).clamp_min(1e-12) / 2
    parts = [center + factor * (candidates - center) for factor in PLAN.wider]
    lowest = torch.where((low < 0) | mirrored, -torch.inf, 0.0)
    highest = torch.where((high > 0) | mirrored, torch.inf, 0.0)
    if mirrored:
        signs = torch.cat([1 - 2 * torch.eye(dim), -torch.ones(1, dim)])
        parts += [torch.zeros(1, dim), *(candidates * sign for sign in signs)]
    every = torch.cat(parts).unique(dim=0)
    distance = ((every - every.clamp(low, high)) / half).square().sum(-1)
    is_beyond = (distance > 1e-9) & ~actions.contains(every)
    is_beyond &= ((every >= lowest) & (every <= highest)).all(-1)
    every, distance = every[is_beyond], distance[is_beyond]
    order = torch.argsort(distance, stable=True)[: 4 * limit]
    # Spread over the distances rather than the nearest alone.
    return spread_out(every[order], limit)


def spread_out(candidates: Tensor, limit: int) -> Tensor:
    """Return at most so many, evenly in their order, with the first and the last."""
    if len(candidates) <= limit:
        return candidates
    return candidates[torch.linspace(0, len(candidates) - 1, limit).round().long()]


class PredictedRival:
    """A rival of the closed loop, as the designer wants it.

    Args:
        rivals: The models.
        key: Key of this rival.
        probability: Probability of this rival, those of all rivals adding up to one.
        candidates: Candidates, all actions that will be asked for, shape (a,
            action_dim). They are predicted together, each as the next trial.
    """

    def __init__(
        self, rivals: RivalSet, key: ModelKey, probability: float, candidates: Tensor
    ) -> None:
        self.probability, self.candidates = probability, candidates
        self._outcomes = lru_cache(1)(partial(_outcomes, rivals, key, candidates))

    def predict(
        self, action: Tensor, num_samples: int, seed: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return draws from the posterior predictive, shape (n, q).

        Also returns the draws without noise, and its standard deviations.

        Args:
            action: One of the candidates, shape (action_dim,).
            num_samples: Number of draws n.
            seed: Seed of the draws.
        """
        same = (self.candidates == action.to(self.candidates)).all(-1)
        every = self._outcomes(num_samples, seed)
        x, mean, sd = every[:, :, int(same.int().argmax())]
        return x, mean, sd


def _outcomes(
    rivals: RivalSet, key: ModelKey, candidates: Tensor, num_samples: int, seed: int
) -> Tensor:
    """Return outcomes, means and deviations, shape (3, n, a, q).

    Outcomes are NaN where there is none.
    """
    trials = following(rivals, candidates)
    options = {"num_draws": num_samples, "seed": seed, "scored": False}
    prediction = predict(rivals, trials, key=key, **options)
    trial = prediction.measurements.trial
    x = np.where(prediction.valid[:, trial], prediction.x, np.nan)
    every = np.stack([x, prediction.mean, prediction.sd])
    each = [np.flatnonzero(trial == t) for t in range(len(trials))]
    return torch.from_numpy(np.stack([every[:, :, at] for at in each], 2))


def choose_action(
    rivals: RivalSet, tracing: Tracing, actions: ActionSpace, *, outside: bool = True
) -> NextAction:
    r"""Return the action of the largest information about the model index.

    It is a lower bound on :math:`I(k; x | \xi)` from draws of each rival's posterior
    predictive, chosen on one half of them and reported on the other. Where it is below
    .02 nats for every permitted action, or some of the rivals are equivalent, actions
    beyond the permitted range are tried: one that separates them is named.

    If every model misses, rivals are weighted by their errors on left-out trials, since
    their probabilities are too sure. Their residuals are a part of their predictions.

    Args:
        rivals: The models.
        tracing: Tracing with their probabilities.
        actions: The permitted ones.
        outside: Whether to try others where these separate nothing.
    """
    candidates = permitted_candidates(rivals, actions)
    own, misfit = _Choosing(rivals, tracing), tracing.misfit
    shares = tracing.probabilities if misfit is None else misfit.weights
    named = [n for n, p in shares.items() if p > PLAN.negligible][: PLAN.max_rivals]
    gain, action = np.zeros(len(candidates)), None
    if len(named) > 1:
        p = np.array([shares[n] for n in named])
        action, gain = own.most_telling(named, p / p.sum(), candidates)
    found = NextAction(
        action=action,
        candidates=candidates.double().numpy(),
        information_gain=gain,
        separates=(*named,),
    )
    if len(named) < 2:
        return found
    groups = [g & {*named} for g in tracing.equivalent]
    if action is None:
        groups.append(frozenset(named))
    groups = [g for g in dict.fromkeys(groups) if len(g) > 1]
    found = replace(found, inseparable=(*groups,))
    if not outside or not groups:
        return found
    others = beyond_range(actions, candidates, limit=PLAN.max_outside, mirrored=True)
    return own.look_outside(found, simulated(rivals, others))


@dataclass(frozen=True)
class _Choosing:
    """Designs that tell rivals apart, by the models and the verdict on them."""

    rivals: RivalSet
    tracing: Tracing

    def most_telling(
        self, names: Sequence[str], p: Array, candidates: Tensor
    ) -> tuple[Array | None, Array]:
        """Return the best candidate, None if it tells nothing, and what each tells."""
        design = self.select(names, p, candidates)
        gain = design.expected_information_gain.clamp_min(0.0).numpy()
        told = gain[design.index]
        others = np.flatnonzero(gain >= PLAN.something)
        if told < PLAN.nothing and len(others):
            # The draws that chose it do not report: at some of them alone it tells
            # much.
            part = candidates[torch.from_numpy(others)]
            design = self.select(names, p, part, again=True)
            gain[others] = design.expected_information_gain.clamp_min(0.0).numpy()
            told = gain[others[design.index]]
        return (design.action.double().numpy() if told >= PLAN.nothing else None), gain

    def look_outside(self, found: NextAction, others: Tensor) -> NextAction:
        """Return the choice with an action that is not permitted, if one separates."""
        for group in found.inseparable if len(others) else ():
            names = [n for n in found.separates if n in group]
            design = self.select(names, np.full(len(names), 1 / len(names)), others)
            gain = float(design.expected_information_gain[design.index])
            error = float(design.standard_error[design.index])
            if gain - 2 * error >= PLAN.nothing and gain > found.outside_gain:
                found = replace(
                    found,
                    outside=design.action.double().numpy(),
                    outside_separates=(*names,),
                    outside_gain=gain,
                )
        return found

    def select(
        self, names: Sequence[str], p: Array, candidates: Tensor, *, again: bool = False
    ) -> Design:
        """Return the design that tells rivals apart, of some probabilities."""
        evidences, rivals = self.tracing.evidences, self.rivals
        models = [
            PredictedRival(rivals, evidences[name].key, float(share), candidates)
            for name, share in zip(names, p, strict=True)
        ]
        designer = InformationGainDesigner(
            DiscreteActions(candidates),
            num_samples=PLAN.samples * len(models),
            eliminate=False,  # a part of the samples would be too few for densities
        )
        seed = derive_seed(rivals.seed, "next action", *names, *["again"] * again)
        return designer.select(models, target="model", seed=seed)


def severe_tests(
    rivals: RivalSet, tracing: Tracing, actions: ActionSpace, *, outside: bool = True
) -> tuple[SevereTest, ...]:
    r"""Return the permitted action that tests a named verdict most, and one beyond.

    A verdict may be the alias of an effect that was not declared: it explains the
    trials at hand about as well, with other parameters. Each of its effects stands or
    falls by a trial where the model without it expects an outcome far from the
    verdict's prediction,

    .. math::
        d^2 = \min_e \frac{1}{N} \sum_i \frac{(\mu_i - \mu^e_i)^2}{s_i^2},

    with means and standard deviations, noise included, of the verdict's prediction of
    the N numbers of x, and those without an effect e. That without any is a free
    residual, the bare model and the residual process as fitted to the trials. Where a
    trial was, a fit predicts whatever is right: other actions come first. How sure the
    others are does not count: where every model misses they are all as unsure
    everywhere, and what the trials tell best would look like the severest test.

    Args:
        rivals: The models.
        tracing: The verdict; one that names no effect has none.
        actions: The permitted ones.
        outside: Whether to look beyond these.

    References:
        Mayo, Error and the Growth of Experimental Knowledge (1996), on severe tests.
    """
    if not tracing.chosen:
        return ()
    candidates = permitted_candidates(rivals, actions)
    m = rivals.measurements
    # As many as the residual process predicts in memory.
    most = max(PLAN.max_entries // (len(m) * int(np.prod(m.shape[1:]))), 2)
    few = min(PLAN.max_tests, most) * outside
    farther = simulated(rivals, beyond_range(actions, candidates, limit=few))
    inside = _most_severe(rivals, tracing, spread_out(candidates, most))
    beyond = [_most_severe(rivals, tracing, farther, False)] if len(farther) else []
    return (inside, *beyond)


def _most_severe(
    rivals: RivalSet, tracing: Tracing, candidates: Tensor, is_permitted: bool = True
) -> SevereTest:
    options: dict[str, Any] = {"num_draws": PLAN.num_draws, "scored": False}
    predicted = partial(predict, rivals, following(rivals, candidates), **options)
    verdict = predicted(key=tracing.key)
    sd, trial = verdict.moments()[1], verdict.measurements.trial
    size = np.maximum(np.bincount(trial, minlength=len(candidates)), 1)

    def difference_without(name: str) -> Array:
        rest = tracing.key.without(name)
        if not rest.effects:
            # Where every model has a residual process, the bare model has one too.
            rest = ModelKey(error=None if tracing.misfit else UNEXPLAINED)
        square = ((verdict.middle - predicted(key=rest).middle) / sd) ** 2
        return np.sqrt(np.bincount(trial, square, minlength=len(candidates)) / size)

    # What helps beside a named cause is not what is to be tested.
    names = (tracing.misfit and tracing.misfit.named) or tracing.chosen
    difference = np.min([difference_without(name) for name in names], axis=0)
    tried = distance_from(rivals.trials.action, candidates).numpy() == 0
    best = int(np.argmax(np.where(tried & ~tried.all(), -1.0, difference)))
    return SevereTest(
        action=candidates[best].double().numpy(),
        is_permitted=is_permitted,
        difference=float(difference[best]),
    )
