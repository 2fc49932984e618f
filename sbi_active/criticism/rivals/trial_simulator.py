"""Simulates all trials for many parameters at once."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.changes import at_times
from sbi_active.criticism.effects.effect import Context
from sbi_active.criticism.effects.trial_conditions import (
    conditions_of_trials,
    has_own_times,
)
from sbi_active.inference.sampling.row_cache import RowCache
from sbi_active.seeding import derive_seed, forked_generators, row_seeds

Prediction = tuple[Array, "Array | None", Array]

#: Draws a row from which a stochastic simulator's mean and deviation are taken.
NUM_REPLICATES = 32
#: Numbers of x in memory at once, and predicted numbers that are kept.
CHUNK = KEPT = 8_000_000


class TrialSimulator:
    r"""Predicts the measured numbers of all trials, for n parameters in one batch.

    A simulator without declared noise is its own draw. Its mean and standard deviation
    then come from 32 draws under fixed seeds, the same for all parameters: the
    synthetic likelihood, Gaussian given these two, is a smooth function of the
    parameters wherever the simulator is one of its parameters and seeds, or of what the
    global generators draw.

    Args:
        model: Simulator with every effect that any rival has.
        trials: The trials.
        seed: Seed of the replicates.

    Attributes:
        measurements: Measurements that are predicted.
        num_simulations: Trials predicted so far; a deterministic simulator runs once
            for those with the same inputs.
        failed: Whether any of them had no outcome.
        is_stochastic: Whether the simulator is the draw.

    References:
        Wood, Nature 466 (2010); Price et al., J. Comput. Graph. Stat. 27 (2018).
    """

    def __init__(
        self, model: AugmentedSimulator, trials: Trials, *, seed: int = 0
    ) -> None:
        self.model, self.trials, self.seed = model, trials, seed
        times = model.sample_times if has_own_times(model.base, trials) else None
        self._model_times = None if times is None else times.double().numpy()
        names = () if model.noise is None else model.noise.parameter_names
        self.measurements = Measurements.of(
            trials, self._model_times, is_sequence="correlation_time" in names
        )
        self.is_stochastic = model.noise is None
        self._repeats = NUM_REPLICATES if self.is_stochastic else 1
        self.num_simulations, self.failed = 0, False
        self._dtype = torch.float64
        self._known: RowCache[Prediction] = RowCache(KEPT)
        # A label is part of what the simulator gets, so that no trial repeats another.
        self._has_repeats = not trials.action_is_label and len(
            torch.unique(trials.settings(), dim=0)
        ) < len(trials)
        # The scale of a declared noise is no part of the mean.
        self._of_noise = {
            e.name
            for e in model.effects
            if e.hook == "noise" and not self.is_stochastic
        }

    def __len__(self) -> int:
        return len(self.trials)

    def predict(
        self, theta: Tensor, phi: dict[str, Tensor]
    ) -> tuple[Array, Array | None, Array]:
        """Return the simulator's predictions of the measured numbers.

        Args:
            theta: Parameters, shape (n, theta_dim).
            phi: Parameters by effect, shape (n, phi_dim), or (n, t, phi_dim) of scope
                "trial".

        Returns:
            The mean, shape (n, N), NaN where the simulator gives no number; the
            deviation, shape (n, N), None if the noise is declared; the probability
            that each trial has an outcome, shape (n, t).
        """
        names = [name for name in phi if name not in self._of_noise]
        columns = [theta, *[phi[name].reshape(len(theta), -1) for name in names]]
        rows = torch.cat([part.double() for part in columns], 1).numpy()

        def simulate(at: Array) -> list[Prediction]:
            numbers = int(np.prod(self.measurements.shape)) + self._num_inputs()
            most = max(1, CHUNK // max(1, numbers * self._repeats))
            if self.is_stochastic and not self.model.base.fn_takes_seeds:
                most = 1  # the global generators draw the same for all
            found = []
            for start in range(0, len(at), most):
                some = at[start : start + most]
                found += self._predict(
                    theta[some], {k: p[some] for k, p in phi.items()}
                )
            return found

        found = self._known.get((*names,), rows, simulate)
        mean, sd, valid = zip(*found, strict=True)
        joined = None if sd[0] is None else np.stack(sd)
        return np.stack(mean), joined, np.stack(valid)

    def _num_inputs(self) -> int:
        """Return the count of numbers in all trials' inputs."""
        inputs, source = self.trials.inputs, self.model.base.inputs
        if inputs is None and source is not None:
            inputs = source.inputs(self.trials.action)
        return sum(u.numel() for u in (inputs or {}).values())

    def noise_scale(self, phi: dict[str, Tensor], num: int) -> Array | None:
        """Return the factor on the noise, shape (n, N); None without such effects."""
        if not any(e.hook == "noise" and e.name in phi for e in self.model.effects):
            return None
        action, context = self._rows(num, 1)
        shape = self.measurements.shape
        one = torch.ones(num * shape[0], *shape[1:], dtype=self._dtype)
        scale = self.model.noise_scale(
            self._tiled(phi, 1), action, one, context=context
        )
        flat = scale.double().numpy().reshape(num, -1)
        return flat[:, self.measurements.position]

    def _predict(self, theta: Tensor, phi: dict[str, Tensor]) -> list[Prediction]:
        """Return what :meth:`predict` returns, row by row."""
        n, t, repeats = len(theta), len(self.trials), self._repeats
        self.num_simulations += n * t * repeats
        action, context = self._rows(n, repeats)
        seeds = None
        if self.is_stochastic:
            seeds = row_seeds(self.seed, t * repeats).repeat(n)
        rows, tiled = theta.repeat_interleave(t * repeats, 0), self._tiled(phi, repeats)
        with forked_generators(derive_seed(self.seed, "replicates")):
            x = self._simulate(rows, tiled, action, context, seeds)
        x = x.reshape(n, repeats, t, *x.shape[1:])
        flat = self._at_measured_times(x)  # (n, repeats, t * numbers)
        valid = np.isfinite(flat.reshape(n, repeats, t, -1)).any(-1).mean(1)
        self.failed |= bool((valid < 1).any())
        picked = flat[..., self.measurements.position]
        mean, sd = picked[:, 0], [None] * n
        if self.is_stochastic:
            mean, sd = _moments(picked)
        return [*zip(mean, sd, valid, strict=True)]

    def _simulate(
        self,
        theta: Tensor,
        phi: dict[str, Tensor],
        action: Tensor,
        context: Context,
        seeds: Tensor | None,
    ) -> Tensor:
        while True:
            dtype = self._dtype
            try:
                return self.model.evaluate(
                    theta.to(dtype),
                    {name: p.to(dtype) for name, p in phi.items()},
                    action.to(dtype),
                    context=context,
                    seeds=seeds,
                    merge=self._has_repeats,
                )
            except RuntimeError as error:
                # A simulator that holds single-precision tensors of its own.
                words = "dtype", "Double"
                told = any(word in str(error) for word in words)
                if not told or dtype == torch.float32:
                    raise
                self._dtype = torch.float32

    def _rows(self, num: int, repeats: int) -> tuple[Tensor, Context]:
        """Return action and conditions, one row a trial, for all parameters."""
        rows = torch.arange(len(self.trials)).repeat(num * repeats)
        context = conditions_of_trials(self.trials, rows, self.model.base)
        return self.trials.action.to(self._dtype)[rows], context

    def _tiled(self, phi: dict[str, Tensor], repeats: int) -> dict[str, Tensor]:
        t = len(self.trials)
        return {
            name: (
                p.repeat_interleave(t * repeats, 0)
                if p.ndim == 2
                else p.repeat_interleave(repeats, 0).reshape(-1, p.shape[-1])
            ).to(self._dtype)
            for name, p in phi.items()
        }

    def _at_measured_times(self, x: Tensor) -> Array:
        """Return x at the trials' sample times, shape (n, repeats, t * numbers)."""
        x, shape = x.double(), self.measurements.shape[1:]
        times, own = self.trials.sample_times, self._model_times
        if times is not None and own is not None:
            stamps = times.double().expand(x.shape[2], shape[0])
            same = stamps.shape[1] == len(own) and np.allclose(stamps, own[None])
            x = x if same else _interpolate(x, torch.from_numpy(own), stamps)
        if x.shape[3:] != shape:
            raise ValueError(
                f"expected trials of the simulator's shape {tuple(x.shape[3:])}; got "
                f"x of shape {shape} a trial; measure what the simulator returns, "
                "or give sample_times to both"
            )
        return x.flatten(2).numpy()


def _moments(x: Array) -> tuple[Array, Array]:
    """Return mean and deviation over replicates, shape (n, r, N), of those with x.

    NaN where fewer than a quarter of them, and at least 4, give a number.
    """
    finite = np.isfinite(x)
    count = finite.sum(1)
    enough = count >= max(4, x.shape[1] // 4)
    safe = np.maximum(count, 2)
    mean = np.where(finite, x, 0.0).sum(1) / safe
    square = np.where(finite, x - mean[:, None], 0.0) ** 2
    sd = np.sqrt(square.sum(1) / (safe - 1)) + 1e-12
    return np.where(enough, mean, np.nan), np.where(enough, sd, np.nan)


def _interpolate(x: Tensor, own: Tensor, stamps: Tensor) -> Tensor:
    """Return x, shape (n, r, t, k, ...), linearly at stamps (t, m); ends are held."""
    first, last, step = float(own[0]), float(own[-1]), float(own.diff().max())
    is_known = stamps.isfinite()
    low = float(stamps.where(is_known, torch.inf).min())
    high = float(stamps.where(is_known, -torch.inf).max())
    if low < first - step or high > last + step:
        raise ValueError(
            f"expected sample_times within those of the simulator, {first:g} to "
            f"{last:g}; got {low:g} to {high:g}; simulate for longer, or leave "
            "the samples beyond out"
        )
    rows, wanted = x.flatten(0, 2), stamps.nan_to_num(first).clamp(first, last)
    every = wanted.repeat(len(rows) // len(wanted), 1), own.expand(len(rows), -1)
    found = at_times(rows, *every)
    return found.reshape(*x.shape[:3], *found.shape[1:])
