"""Parameters of a simulator that no permitted action tells apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.identifiability.formula import Combination, Term, linked
from sbi_active.identifiability.search import FormulaSettings, search
from sbi_active.identifiability.sensitivities import (
    ProbeSettings,
    Sensitivities,
    Simulate,
    moved_along,
)

#: What a direction does to x, exactly nothing or about.
WHAT = {
    True: "changes nothing",
    False: "changes x by less than a tenth of the noise in a prior deviation",
}

DO = "fix one of them, or permit actions that they change differently"


@dataclass(frozen=True)
class Undetermined:
    """Parameters that no permitted action determines, as far as was tried.

    Attributes:
        parameters: Names of the parameters.
        known: The combinations through which the outcome depends on them; empty if
            it does not, or where there is no short formula.
        is_exact: Whether the outcome is the same, rather than within a tenth of the
            noise.
        text: Text in words, with what to do.
    """

    parameters: tuple[str, ...]
    known: tuple[str, ...]
    is_exact: bool
    text: str

    def __str__(self) -> str:
        return self.text

    __repr__ = __str__


def find_undetermined(
    simulate: Simulate,
    prior: Distribution,
    actions: Tensor,
    names: Sequence[str],
    *,
    skip: Sequence[int] = (),
    num_rows: int = 256,
    num_numbers: int = 1,
    num_permitted: int | None = None,
    seed: int = 0,
    settings: ProbeSettings = ProbeSettings(),  # noqa: B008  (frozen)
) -> tuple[Undetermined, ...]:
    r"""Return parameters that no permitted action tells apart, and what it would see.

    Parameters and actions are drawn, and the rows simulated with the same random
    numbers at parameters a little apart. The derivatives J of x, in noise units by
    prior deviations and stacked over all actions, give the directions that change
    nothing, and with them :math:`C = (S^{-1} + n J^T J)^{-1}`, the covariance that n
    trials of each action would leave at a set of parameters (the Fisher information,
    where noise is added to the outcome). Its mean over the sets gives formulas by
    :func:`.search`.

    Each formula is then tested: parameters are moved along it, by most of a prior
    deviation if the support allows it, and if x moves by more than a tenth of the noise
    the formula is dropped. The same outcome under the same random numbers is the same
    distribution, so that the result holds at the places that were tried, whatever the
    noise; the reverse is not true, and more may be undetermined.

    Args:
        simulate: The simulator.
        prior: Prior of its parameters.
        actions: Actions to try, shape (a, action_dim); the first 16 are.
        names: Names of the parameters.
        skip: Parameters that are skipped since they change nothing.
        num_rows: Rows a call of the simulator; it is called 2 d + 2 times, and twice
            for what is found.
        num_numbers: Number of an outcome's numbers; many of them get fewer rows.
        num_permitted: Actions that are permitted; None is endless.
        seed: Seed of the draws.
        settings: Settings of what is tried, and of what counts as the same.

    Returns:
        One a group of parameters; empty if all are told apart.

    References:
        Rothenberg, Identification in parametric models, Econometrica 1971; Raue et al.,
        Bioinformatics 2009; Gutenkunst et al., PLoS Comput. Biol. 2007.
    """
    free = [i for i in range(len(names)) if i not in skip]
    own, actions = settings, actions[: settings.most_actions]
    num_rows = min(num_rows, own.most_numbers // (num_numbers * max(len(free), 1)))
    num_theta = min(num_rows // len(actions), own.most_sets)
    if num_theta < own.fewest_sets or not free:
        return ()
    probe = Sensitivities(simulate, prior, actions, free, num_theta, seed, own)
    if not np.isfinite(probe.base).any():
        return ()
    is_all = num_permitted is not None and num_permitted <= len(actions)
    tried = f"none of {len(actions)} actions that were tried"
    where = "no permitted action" if is_all else tried
    about = probe, names, where
    return _formulas(*about, False) or _formulas(*about, True) or _local(*about)


def _formulas(
    probe: Sensitivities, names: Sequence[str], where: str, practical: bool
) -> tuple[Undetermined, ...]:
    """Return groups with a formula that holds where it was tried."""
    covariances, own = probe.covariances(practical), probe.own
    place = {i: k for k, i in enumerate(probe.free)}
    theta = probe.theta.double().numpy()
    alone = np.sqrt(covariances.diagonal(axis1=1, axis2=2).mean(0))
    open_parameters = [i for i in probe.free if alone[place[i]] > own.open]

    def moments(terms: Sequence[Term]) -> tuple[Array, Array]:
        at = [place[t.index] for t in terms]
        slopes = np.stack([t.slope(theta) * probe.deviation[t.index] for t in terms], 1)
        known = covariances[:, at][:, :, at] * slopes[:, :, None] * slopes[:, None, :]
        prior = np.cov(np.stack([t.coordinate(probe.draws) for t in terms]))
        return known.mean(0), prior.reshape(len(terms), len(terms))

    low, span = probe.draws.min(0), np.ptp(probe.draws, 0)
    formulas = FormulaSettings(floor=own.floor)
    found = search(moments, open_parameters, low, span, formulas)
    groups = linked([c for c, _ in found])
    named = {i for c, _ in found for i in c.index}
    lonely = [i for i in open_parameters if i not in named]
    candidates = [(sorted({i for c in g for i in c.index}), g) for g in groups]
    candidates += [([i], []) for i in lonely if alone[place[i]] > own.alone]
    told = []
    for indices, group in candidates:
        about, exactly = _holds(probe, indices, group)
        if about and len(indices) > len(group):
            each = tuple(names[i] for i in indices)
            known = tuple(c.text(names) for c in group)
            text = _sentence(each, known, exactly, where)
            told.append(Undetermined(each, known, exactly, text))
    return tuple(told)


def _holds(
    probe: Sensitivities, indices: Sequence[int], group: Sequence[Combination]
) -> tuple[bool, bool]:
    """Return whether x is about, or exactly, the same where the combinations are."""
    moved = (moved_along(probe, indices, group, turn) for turn in range(2))
    found = [(False, False) if theta is None else probe.same(theta) for theta in moved]
    about, exactly = zip(*found, strict=True)
    return all(about), all(exactly)


def _local(
    probe: Sensitivities, names: Sequence[str], where: str
) -> tuple[Undetermined, ...]:
    """Return groups that change nothing at each parameter set, without a formula."""
    size, vectors = probe.singular()
    if not (size == 0).any(1).all():
        return ()
    direction = vectors[:, :, -1]
    step = np.zeros_like(probe.draws[: len(direction)])
    small = 3 * probe.own.step
    step[:, probe.free] = small * direction * probe.deviation[probe.free]
    moves = torch.from_numpy(step).float()
    about, exactly = probe.same(probe.theta + moves, probe.theta - moves, 2 * small)
    if not about:
        return ()
    shares = np.sqrt((direction**2).mean(0))
    moved = zip(probe.free, shares, strict=True)
    own = tuple(names[i] for i, share in moved if share > probe.own.same)
    if len(own) < 2:
        return ()
    text = (
        f"{where} determines all of {_and(own)}: at each of {len(direction)} draws of "
        f"the prior one direction {WHAT[exactly]}; {DO}"
    )
    return (Undetermined(own, (), exactly, text),)


def _sentence(
    own: tuple[str, ...], known: tuple[str, ...], exactly: bool, where: str
) -> str:
    if not known:
        return (
            f"{where} determines {own[0]}: all over the prior it changes x by less "
            "than a tenth of the noise; fix it, or permit actions that it changes more"
        )
    through = _and(known)
    what = "" if exactly else ", to a tenth of the noise,"
    return (
        f"{where} tells {_and(own)} apart: x depends on them{what} through {through} "
        f"alone; {DO}"
    )


def _and(texts: Sequence[str]) -> str:
    return f"{', '.join(texts[:-1])} and {texts[-1]}" if texts[1:] else texts[0]
