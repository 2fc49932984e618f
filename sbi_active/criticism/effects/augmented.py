"""A simulator with effects, itself a simulator."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.criticism.effects.application import applied
from sbi_active.criticism.effects.effect import Context, Effect, require_distinct
from sbi_active.expected import require
from sbi_active.seeding import forked_generators, row_seeds
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.conditions import (
    CONDITIONS,
    at_rows,
    changed,
    played,
    typed,
)
from sbi_active.simulation.model import NOISE_STREAM

#: Rows on which an effect is compared with the simulator without it; of those that are
#: simulated in any case, so many that x of two channels leaves more than one.
NUM_CHECKED, NUM_FIRST = 16, 3


Phi = dict[str, Tensor]  # parameters by effect, shape (n, phi_dim)


@dataclass(frozen=True)
class _Rows:
    """Effects in rows: phi, actions as commanded, conditions, and further keywords."""

    phi: Phi
    action: Tensor
    context: Context
    keywords: dict[str, Any]

    def at(self, some: slice) -> _Rows:
        """Return some rows, without effects."""
        return _Rows({}, self.action[some], self.context.at(some), {})


class AugmentedSimulator(SimulatorModel):
    r"""A simulator whose parameters are :math:`(\theta, \phi)`.

    In order, effects change the parameters, the action, the inputs over time, the
    keyword arguments of the simulator's function, the noise-free x, and the noise:

    .. math::
        x = h_x\bigl(f(h_\theta(\theta), h_\xi(\xi); h_f)\bigr) + h_s(s)\,\epsilon .

    Called as any simulator, with (theta, phi) and an action, the rows are those of the
    *next* trial, whose index is ``next_index``: an effect that grows with the index
    goes on from there. :meth:`evaluate` takes a context, with an index a row.

    Args:
        model: The simulator; an augmented one is extended.
        effects: Effects, each adding its phi to the parameters in this order. Those of
            scope "trial" add none: a call draws their phi for each row.
        check: Parameters (n, theta_dim) and actions (n, action_dim) at which every
            effect is compared with the simulator at its null, and how these trials were
            run where it matters; None compares in the first evaluation.
        next_index: Index of the trial that a plain call simulates.

    Raises:
        ValueError: If two effects share a name, or one does not vanish at its null.

    Attributes:
        base: The simulator without any effect.
        effects: Effects, all of them.
    """

    def __init__(
        self,
        model: SimulatorModel,
        effects: Sequence[Effect],
        *,
        check: tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Context] | None = None,
        next_index: int = 0,
    ) -> None:
        is_more = isinstance(model, AugmentedSimulator)
        base, before = (model.base, model.effects) if is_more else (model, [])
        self.base = base
        self.effects = [*before, *effects]
        require_distinct(self.effects, base.parameter_names or ())
        self.next_index = next_index
        names = base.parameter_names
        if names is not None:
            campaign = [e for e in self.effects if e.scope == "campaign"]
            names = [*names, *[n for e in campaign for n in e.phi_names]]
        super().__init__(
            base.fn,
            noise=base.noise,
            batched=base.is_batched,
            setup=base.setup,
            parameter_names=names,
            channel_names=base.channel_names,
            sample_times=base.sample_times,
            inputs=base.inputs,
        )
        self._unchecked = [e for e in effects if e not in before]
        if check is not None and self._unchecked:
            known = sum(e.phi_dim for e in before if e.scope == "campaign")
            theta, action, *own = check
            rows = self._rows({}, action, *own)
            self._check_null(theta[:, : theta.shape[1] - known], rows)

    @property
    @override
    def draws_by_noise_alone(self) -> bool:
        return not any(e.hook == "noise" or e.scope == "trial" for e in self.effects)

    @override
    def without_noise(self) -> AugmentedSimulator:
        bare = copy.copy(self)
        bare.noise = None
        return bare

    def evaluate(
        self,
        theta: Tensor,
        phi: Phi,
        action: Tensor,
        *,
        context: Context | None = None,
        seeds: Tensor | None = None,
        merge: bool = False,
    ) -> Tensor:
        """Return the output of the simulator's function with some effects switched on.

        It is noise-free if the model declares its noise, else a draw.

        Args:
            theta: Parameters of the base simulator, shape (n, theta_dim).
            phi: Parameters by effect, (n, phi_dim); effects that are left out vanish.
            action: Actions as commanded, shape (n, action_dim).
            context: Conditions under which each row's trial was run; None is the next
                trial.
            seeds: Seeds, one a row, for a simulator that takes them; None gives each
                row 0 where the noise is declared.
            merge: Whether to simulate equal rows only once, as where an action was
                repeated.

        Returns:
            Shape (n, *x_shape).
        """
        rows = self._rows(phi, action, context)
        merge = merge and self.noise is not None  # a draw is another at each call
        return self._checked(theta, rows, seeds, merge=merge)

    def noise_scale(
        self, phi: Phi, action: Tensor, sd: Tensor, *, context: Context | None = None
    ) -> Tensor:
        """Return the noise's standard deviation with effects, of the shape of ``sd``.

        Args:
            phi: Parameters by effect, as in :meth:`evaluate`.
            action: Shape (n, action_dim).
            sd: Standard deviation without effects, shape (n, *x_shape).
            context: Context of the rows, as in :meth:`evaluate`.
        """
        return self._through("noise", sd, self._rows(phi, action, context))

    def split(self, parameters: Tensor) -> tuple[Tensor, Phi]:
        """Return theta and phi by effect from (theta, phi), shape (n, dim)."""
        campaign = [e for e in self.effects if e.scope == "campaign"]
        sizes = [e.phi_dim for e in campaign]
        theta_dim = parameters.shape[1] - sum(sizes)
        expected = f"(theta, phi) with {sum(sizes)} numbers for the effects"
        got = f"{parameters.shape[1]} columns"
        require(theta_dim > 0, expected, got, "draw from joint_prior")
        theta, *phi = parameters.split([theta_dim, *sizes], -1)
        return theta, {e.name: p for e, p in zip(campaign, phi, strict=True)}

    @override
    def __call__(
        self, theta: Tensor, action: Tensor, seeds: Tensor | None = None, **effects: Any
    ) -> Tensor:
        drawn = self._trial_draws(len(theta), theta.dtype, seeds)
        mean = self._run(theta, action, seeds, effects, drawn=drawn)
        if self.noise is None:
            return mean
        if self.fn_takes_seeds and seeds is not None:
            seeds = seeds ^ NOISE_STREAM
        x = self.noise.sample(mean, seeds)
        _, phi = self.split(theta)
        # The noise model draws; effects stretch what it drew.
        one = torch.ones_like(x)
        scale = self.noise_scale(phi, action, one)
        return x if scale is one else mean + (x - mean) * scale

    @override
    def _run(
        self, theta: Any, action: Any, seeds: Any, effects: Any, *, drawn: Any = None
    ) -> Tensor:
        theta, phi = self.split(torch.as_tensor(theta))
        rows = self._rows(phi | (drawn or {}), torch.as_tensor(action), **effects)
        return self._checked(theta, rows, seeds)

    def _trial_draws(self, num: int, dtype: torch.dtype, seeds: Tensor | None) -> Phi:
        """Return draws of the effects of scope "trial", rows by their seeds."""
        trial = [e for e in self.effects if e.scope == "trial"]
        if seeds is None or not trial:
            return {e.name: e.sample(num).to(dtype) for e in trial}
        rows = []
        for seed in seeds.tolist():
            with forked_generators(seed, "trial effects"):
                rows.append(torch.cat([e.sample(1) for e in trial], -1))
        draws = torch.cat(rows).to(dtype).split([e.phi_dim for e in trial], -1)
        return {e.name: d for e, d in zip(trial, draws, strict=True)}

    def _rows(
        self, phi: Phi, action: Tensor, context: Context | None = None, **told: Any
    ) -> _Rows:
        """Return rows with what effects may know of them, of the type of actions."""
        if context is None:
            context = Context(torch.full((len(action),), float(self.next_index)))
        own = {name: told.pop(name) for name in [*told] if name not in CONDITIONS}
        known = vars(context) | told
        if known["times"] is None:
            known["times"] = self.sample_times
        return _Rows(phi, action, Context(**typed(known, action.dtype)), own)

    def _checked(
        self, theta: Tensor, rows: _Rows, seeds: Any, *, merge: bool = False
    ) -> Tensor:
        """Return x, after a look at whether effects vanish in the first rows."""
        few = slice(NUM_FIRST)
        if self._unchecked and len(theta):
            self._check_null(theta[few], rows.at(few))
        return self._evaluate(theta, rows, seeds, merge=merge)

    def _evaluate(
        self, theta: Tensor, rows: _Rows, seeds: Any, *, merge: bool = False
    ) -> Tensor:
        if seeds is None and self.noise is not None:
            seeds = torch.zeros(len(theta), dtype=torch.int64)
        theta = self._through("parameter", theta, rows)
        action = self._through("action", rows.action, rows)
        if rows.context.inputs is None and self.base.inputs is not None:
            signals = played(self.base.inputs, action, action.dtype)
            rows = replace(rows, context=replace(rows.context, **signals))
        told = self._through("dynamics", self._told(rows) | rows.keywords, rows)
        run = self._run_merged if merge else self.base._run
        return self._through("observation", run(theta, action, seeds, told), rows)

    def _through(self, hook: str, value: Any, rows: _Rows) -> Any:
        """Return a value as all effects of a hook change it, one after the other."""
        for effect in self.effects:
            if effect.hook == hook and effect.name in rows.phi:
                own = rows.phi[effect.name]
                value = applied(effect, value, own, rows.action, rows.context)
        return value

    def _told(self, rows: _Rows) -> dict[str, Any]:
        """Return what the simulator's function is told of how its trials are run."""
        context, wanted = rows.context, self.base.conditions
        acting = [e for e in self.effects if e.hook == "input" and e.name in rows.phi]
        names = ", ".join(effect.name for effect in acting)
        is_told = not acting or (context.inputs is not None and "inputs" in wanted)
        expected = f"inputs over time for {names}, in the trials and the simulator"
        advice = "pass Trials(inputs=...), and take fn(theta, action, *, inputs)"
        require(is_told, expected, "none in one of them", advice)
        inputs = self._through("input", context.inputs, rows)
        return replace(context, inputs=inputs).told(wanted)

    def _run_merged(
        self, theta: Tensor, action: Tensor, seeds: Any, keywords: dict[str, Any]
    ) -> Tensor:
        """Run each distinct row once."""
        columns: list[Any] = [theta, action, *([] if seeds is None else [seeds])]
        changed(keywords, columns.append)
        per_row = [c for c in columns if np.shape(c)[:1] == (len(theta),)]
        rows = torch.cat([c.reshape(len(theta), -1).double() for c in per_row], 1)
        _, first, place = np.unique(
            rows.numpy(), axis=0, return_index=True, return_inverse=True
        )
        some = None if seeds is None else seeds[first]
        x = self.base._run(theta[first], action[first], some, at_rows(keywords, first))
        return x[place.reshape(-1)]

    def _check_null(self, theta: Tensor, rows: _Rows) -> None:
        """Raise if an effect at its null changes x.

        It may do so by single precision, with room for a formula's rounding.
        """
        tolerance = 1e-4  # in deviations of x over the checked rows
        x = self._seeded(theta, rows)
        shapes = [x.shape, *(u.shape for u in (rows.context.inputs or {}).values())]
        if any(len(x) in shape[1:] for shape in shapes) and len(x) > 1:
            # As many rows as entries hide phi that is spread over the wrong axis.
            self._check_null(theta[:-1], rows.at(slice(-1)))
            return
        finite, one = x[x.isfinite()].double(), torch.ones_like(x)
        spread = float(finite.std()) if len(finite) > 1 else 0.0
        size = max(spread, float(finite.abs().mean()) if len(finite) else 0.0, 1e-30)
        for effect in self._unchecked:
            is_noise, least = effect.hook == "noise", torch.inf
            what, without = ("the noise", one) if is_noise else ("x", x)
            null = [effect.null_phi(len(x)), effect.null_phi(len(x), finite=True)]
            for phi in null if bool(null[0].isinf().any()) else null[:1]:
                own = replace(rows, phi={effect.name: phi.to(x.dtype)})
                at_null = self._seeded(theta, own)
                at_null = self._through("noise", one, own) if is_noise else at_null
                least = min(least, _change(without, at_null))
            require(
                least <= tolerance * (1.0 if is_noise else size),
                f"effect {effect.name!r} to vanish at its null {effect.null}",
                f"{what} changed by up to {least:.3g}",
                "correct apply or null",
            )
            if is_noise:
                phi = effect.declared_draws()[: len(x)].to(x.dtype)
                sd = applied(effect, one, phi, rows.action, rows.context)
                got = f"{float(sd.min()):.3g} times its size at a phi of its prior"
                expected = f"effect {effect.name!r} to keep the noise positive"
                advice = "pass a prior without such phi, or another apply"
                require(bool((sd > 0).all()), expected, got, advice)
        self._unchecked = []

    def _seeded(self, theta: Tensor, rows: _Rows) -> Tensor:
        """Evaluate under fixed seeds, so that a stochastic simulator repeats itself."""
        seeds = row_seeds(0, len(theta))
        with forked_generators(0, "null"):
            return self._evaluate(theta, rows, seeds)


def _change(reference: Tensor, x: Tensor) -> float:
    """Return the largest difference of x; inf if a number turns into NaN or back."""
    same = (x == reference) | (x.isnan() & reference.isnan())
    gap = (x - reference).abs().where(~same, torch.zeros_like(reference))
    return float(gap.nan_to_num(torch.inf).max())
