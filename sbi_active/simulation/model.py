"""A simulator with its noise, names and way of taking seeds."""

from __future__ import annotations

import copy
import inspect
import os
import threading
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions.mixed import MixedActions
from sbi_active.actions.signals import SignalActions
from sbi_active.arrays import own_tensor
from sbi_active.expected import Shown, require, suggests
from sbi_active.seeding import forked_generators, row_seeds
from sbi_active.simulation.conditions import (
    CONDITIONS,
    as_arrays,
    at_rows,
    copied,
    keywords_of,
    parameters_of,
    played,
)
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.gaussian import GaussianNoise
from sbi_active.simulation.simulator import outcome_array, outcome_tensor, require_rows

FEW = 8  # rows that show whether fn is random
ROUNDING = 1e-6  # relative difference that makes no draw
NOISE_STREAM = 0x9E3779B97F4A7C1  # sets the noise's seeds apart from those of fn

# What setup() gave, by process and model: a worker that receives the same model with
# every batch sets it up once.
_contexts: dict[tuple[int, str], Any] = {}
_setting_up = threading.Lock()


class SimulatorModel(Shown):
    r"""A simulator that owns its noise, :math:`x = f(\theta, \xi) + \epsilon`.

    Further keyword arguments of ``fn`` are its *effects*, given to the model by name:
    a number, or one a row, shape (n, ...). Four names say how a trial was run instead:
    ``times``, shape (n, k), at which x is measured; ``inputs`` over time, {name:
    (n, m)}, with their uniform grid ``input_times``, shape (m,); and ``start``,
    measured start states, {name: (n,)}. Trials hand them over, and the model
    its ``sample_times``.

    Args:
        fn: ``fn(theta, action)``, shapes (n, theta_dim) and (n, action_dim), giving
            (n, *x_shape); it may accept ``seeds``, shape (n,). With ``batched=False``,
            ``fn(theta, action, rng)`` of one row: float64 NumPy arrays of shapes
            (theta_dim,) and (action_dim,), and a NumPy generator from the row's seed.
        noise: Noise added to the output of ``fn``; None if ``fn`` is itself the
            draw. A number is the standard deviation of Gaussian noise.
        batched: Whether ``fn`` takes all rows at once.
        setup: Function called without arguments once a process, before the first run;
            ``fn`` receives its result as keyword argument ``context``. It is neither
            pickled nor freed before the process ends.
        parameter_names: Names of the parameters.
        channel_names: Names of the entries of x's last axis; a single one where x is a
            trajectory of one channel, which has no axis of its own.
        sample_times: Time stamps of x's first axis in seconds, shape (T,), for the
            noise.
        inputs: Space of the actions if they are parameters of signals, alone or beside
            others: ``fn`` receives the signals as ``inputs``, unless trials have
            recorded ones.

    Attributes:
        noise: Noise with the time stamps, where there are any.
        effect_names: Names of the effects that ``fn`` declares.
        conditions: Keyword arguments of ``fn`` among ``times``, ``inputs``,
            ``input_times`` and ``start``.
        is_batched: Whether ``fn`` takes all rows at once.
        fn_takes_seeds: Whether each row of ``fn`` is a function of its seed.

    Raises:
        ValueError: If ``fn`` takes no inputs that are given.

    Example:
        >>> from sbi_active.simulation import GaussianNoise
        >>> model = SimulatorModel(lambda theta, xi: theta * xi, noise=GaussianNoise(1))
        >>> model.mean(torch.ones(2, 1), torch.tensor([[2.0], [3.0]])).tolist()
        [[2.0], [3.0]]
    """

    @suggests
    def __init__(
        self,
        fn: Callable[..., Any],
        *,
        noise: NoiseModel | float | Tensor | None = None,
        batched: bool = True,
        setup: Callable[[], Any] | None = None,
        parameter_names: Sequence[str] | None = None,
        channel_names: Sequence[str] | None = None,
        sample_times: Tensor | None = None,
        inputs: SignalActions | MixedActions | None = None,
    ) -> None:
        self.fn, self.setup, self.is_batched = fn, setup, batched
        self.parameter_names = None if parameter_names is None else [*parameter_names]
        self.channel_names = None if channel_names is None else [*channel_names]
        if sample_times is not None:
            sample_times = own_tensor(sample_times, torch.float64, name="sample_times")
        self.sample_times = sample_times
        if noise is not None and not isinstance(noise, NoiseModel):
            noise = GaussianNoise(noise)
        if noise is not None and sample_times is not None:
            noise = noise.at(sample_times)
        self.noise = noise
        keywords = keywords_of(fn, 2 if batched else 3)
        self.fn_takes_seeds = not batched or "seeds" in keywords
        bound = getattr(inspect.unwrap(fn), "keywords", {})  # of a partial function
        self.conditions = tuple(
            name for name in CONDITIONS if name in keywords and name not in bound
        )
        self.inputs = inputs
        require(
            inputs is None or "inputs" in self.conditions,
            "a function that takes the signals of its actions",
            "one without an argument 'inputs'",
            "write fn(theta, action, *, inputs)",
        )
        self.effect_names = tuple(k for k in keywords if k not in ("seeds", "context"))
        self._token = uuid.uuid4().hex
        self._is_deterministic: bool | None = None

    def __call__(
        self,
        theta: Tensor,
        action: Tensor,
        seeds: Tensor | None = None,
        **effects: Any,
    ) -> Tensor:
        """Return one draw a row.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
            seeds: Seeds, one a row, shape (n,); None uses torch's global generator.
            effects: Effects by name, a number or one a row.

        Returns:
            Shape (n, *x_shape).
        """
        x = self._run(theta, action, seeds, effects)
        if self.noise is None:
            return x
        if self.fn_takes_seeds and seeds is not None:
            seeds = seeds ^ NOISE_STREAM
        return self.noise.sample(x, seeds)

    def prepare(self) -> None:
        """Run ``setup`` in this process, unless that has been done."""
        if self.setup is not None:
            self._context()

    def mean(self, theta: Tensor, action: Tensor, **effects: Any) -> Tensor:
        """Return the noise-free output, shape (n, *x_shape).

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
            effects: Effects by name, a number or one a row.

        Raises:
            ValueError: If the model was built without a noise model, or ``fn`` is
                random: it is then a draw itself. The latter is looked up once, on the
                first few rows of the first call.
        """
        if self.noise is None:
            raise ValueError(
                "expected a simulator with a noise model; got noise=None, a random "
                "draw; build SimulatorModel(fn, noise=GaussianNoise(sd))"
            )
        if not self.is_deterministic(theta, action, **effects):
            raise ValueError(
                "expected a noise-free fn beside declared noise; got different outputs "
                "from two seeds, so that noise would count twice; remove the random "
                "numbers from fn, or build SimulatorModel(fn, noise=None)"
            )
        seeds = torch.zeros(len(theta), dtype=torch.int64)
        return self._run(theta, action, seeds, effects)

    @property
    def draws_by_noise_alone(self) -> bool:
        """Whether a draw is the mean with ``noise`` as declared, and no more."""
        return self.noise is not None

    def without_noise(self) -> SimulatorModel:
        """Return a model of ``fn`` alone, which has other worker processes."""
        bare = copy.copy(self)
        bare.noise = bare.parameter_names = bare.channel_names = None
        if "times" not in self.conditions:
            bare.sample_times = None
        return bare

    def is_deterministic(self, theta: Tensor, action: Tensor, **effects: Any) -> bool:
        """Return whether ``fn`` gives the same output under two seeds.

        The first call runs ``fn`` twice on at most 8 rows; its answer is kept.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
            effects: Effects by name, a number or one a row.
        """
        if self._is_deterministic is None:
            few = at_rows(effects, slice(FEW))
            self._is_deterministic = self._agrees(theta[:FEW], action[:FEW], few)
        return self._is_deterministic

    def _agrees(
        self, theta: Tensor, action: Tensor, effects: Mapping[str, Any]
    ) -> bool:
        """Compare two seeds; rows that raise have no say where others do not."""

        def drawn(seed: int) -> Tensor:
            with forked_generators(seed, "deterministic"):
                return self._run(theta, action, row_seeds(seed, len(theta)), effects)

        try:
            return torch.allclose(drawn(0), drawn(1), ROUNDING, 0.0, equal_nan=True)
        except Exception:
            if len(theta) == 1:
                raise
            answers = []
            for i in range(len(theta)):
                row = slice(i, i + 1)
                with suppress(Exception):
                    own = at_rows(effects, row)
                    answers.append(self._agrees(theta[row], action[row], own))
            if not answers:
                raise
            return all(answers)

    def _run(
        self,
        theta: Tensor,
        action: Tensor,
        seeds: Tensor | None,
        effects: Mapping[str, Any],
    ) -> Tensor:
        theta, action = torch.as_tensor(theta), torch.as_tensor(action)
        require_rows(theta, action)
        self._require_names("parameters", self.parameter_names, theta, "theta")
        given = {**self._own_conditions(theta, action, effects), **effects}
        if self.fn_takes_seeds and seeds is None:
            seeds = torch.randint(2**62, (len(theta),))
        keywords = {} if self.setup is None else {"context": self._context()}
        if not self.is_batched:
            x = self._run_rows(theta, action, seeds, given, keywords)
        else:
            if self.fn_takes_seeds:
                keywords["seeds"] = copied(seeds)
            x = self.fn(theta.clone(), action.clone(), **copied(given), **keywords)
        x = outcome_tensor(x, len(theta))
        # A trajectory of one channel has no axis of its own for it.
        if x.ndim > 2 or len(self.channel_names or ()) != 1:
            self._require_names("channels", self.channel_names, x, "x")
        return x

    def _require_names(
        self, what: str, names: list[str] | None, rows: Tensor, of: str
    ) -> None:
        """Raise if the last axis of rows has not one entry a name."""
        fits = names is None or len(names) == rows.shape[-1]
        expected = f"{len(names or ())} {what}, {', '.join(names or ())}"
        got = f"{of} of shape {tuple(rows.shape)}"
        require(fits, expected, got, "name the entries of its last axis")

    def _own_conditions(
        self, theta: Tensor, action: Tensor, given: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the conditions of trials that the model itself knows."""
        found = {}
        if "times" in self.conditions and self.sample_times is not None:
            times = self.sample_times.to(theta.dtype)
            found["times"] = times.expand(len(theta), -1)
        if self.inputs is not None and "inputs" not in given:
            signals = played(self.inputs, action, theta.dtype)
            found |= {k: v for k, v in signals.items() if k in self.conditions}
        return found

    def _run_rows(
        self,
        theta: Tensor,
        action: Tensor,
        seeds: Any,
        effects: Mapping[str, Any],
        keywords: Mapping[str, Any],
    ) -> np.ndarray:
        thetas, actions = (as_arrays(r.detach().cpu()) for r in (theta, action))
        arrays, rows = as_arrays(effects), []
        for i, seed in enumerate(seeds.tolist()):
            row = thetas[i].copy(), actions[i].copy(), np.random.default_rng(seed)
            x = outcome_array(self.fn(*row, **copied(at_rows(arrays, i)), **keywords))
            rows.append(x.copy())  # x may be the view of what the next row changes
            expected, got = (
                f"rows of one shape, {rows[0].shape}",
                f"{x.shape} in row {i}",
            )
            advice = "fill what is missing with NaN"
            require(x.shape == rows[0].shape, expected, got, advice)
        return np.stack(rows) if rows else np.empty((0, 1))

    def _context(self) -> Any:
        key = os.getpid(), self._token
        with _setting_up:
            if key not in _contexts and self.setup is not None:
                _contexts[key] = self.setup()
        return _contexts[key]


def takes_seeds(simulator: Callable[..., Any]) -> bool:
    """Return whether each row of the simulator is a function of its seed."""
    if isinstance(simulator, SimulatorModel):
        has_no_use = simulator.noise is None and simulator._is_deterministic is True
        return simulator.fn_takes_seeds or has_no_use
    return "seeds" in [p.name for p in parameters_of(simulator)]
