"""Actions that are played: parameters of a signal over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions.box import BoxActions
from sbi_active.arrays import own_tensor
from sbi_active.expected import require
from sbi_active.seeding import forked_generators

Limit = float | tuple[float, float]


class SignalActions(BoxActions):
    r"""Parameters :math:`\xi` of a signal :math:`u(t; \xi)` that a robot can play.

    An action is permitted if its parameters are within their limits and its signal
    within those of the robot. :meth:`inputs` gives the series to play, which a
    simulator ``SimulatorModel(fn, inputs=space)`` receives as keyword ``inputs``, its
    grid as ``input_times``.

    Args:
        generator: ``generator(action, input_times)`` of shapes (n, action_dim) and (m,)
            gives {name: (n, m)}, or (n, m) for one called "input". Ready ones are
            :func:`.chirp`, :func:`.step`, :func:`.multisine` and :func:`.recorded` of
            ``sbi_active.actions.waveforms``.
        low: Lower limits of the parameters, a number or shape (action_dim,).
        high: Upper limits, as ``low``. Neither is needed if the generator lists its
            actions.
        input_times: Uniform grid of the signal in s, shape (m,); None takes that of the
            generator.
        names: Names of the entries of the action; None takes those of the generator.
        units: Units of the entries, as ``names``.
        amplitude: Limits of each value, a number for its size or (lowest, highest), for
            all inputs or by name; None for none.
        rate: Largest change of an input in a second, between points of the grid, a
            number or by name.
        duration: Limits in s of the time from the first to the last value that is not
            0, a number for the longest or (shortest, longest).

    Attributes:
        batch: Number of draws at once.
        patience: Number of such batches without a permitted action after which it is an
            error.
        rounding: Relative excess over a limit that is rounding.

    Raises:
        ValueError: If the grid is not uniform, limits are none, or no action is
            permitted.

    Example:
        >>> from sbi_active.actions.waveforms import chirp
        >>> times = torch.linspace(0, 2, 201)
        >>> space = SignalActions(
        ...     chirp("voltage"), [0.1, 0.1, 1.0], [5.0, 1.0, 10.0],
        ...     input_times=times, amplitude=4.0, rate=100.0,
        ... )
        >>> space.names
        ['amplitude', 'start frequency', 'end frequency']
        >>> space.contains(torch.tensor([[3.0, 0.5, 4.0], [5.0, 0.5, 4.0]]))
        tensor([ True, False])
        >>> space.inputs(torch.tensor([3.0, 0.5, 4.0]))["voltage"].shape
        torch.Size([201])
    """

    batch: ClassVar[int] = 256
    patience: ClassVar[int] = 40
    rounding: ClassVar[float] = 1e-4

    def __init__(
        self,
        generator: Callable[[Tensor, Tensor], Any],
        low: float | Tensor | np.ndarray | Sequence[float] | None = None,
        high: float | Tensor | np.ndarray | Sequence[float] | None = None,
        *,
        input_times: Any = None,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        amplitude: Limit | Mapping[str, Limit] | None = None,
        rate: float | Mapping[str, float] | None = None,
        duration: Limit | None = None,
    ) -> None:
        self.generator = generator
        self._values: Tensor | None = getattr(generator, "values", None)
        if self._values is not None and low is None and high is None:
            low, high = self._values.amin(0) - 0.5, self._values.amax(0) + 0.5
        if low is None or high is None:
            raise ValueError(
                "expected limits of a signal's parameters; got none; pass low and high"
            )
        names = getattr(generator, "names", None) if names is None else names
        units = getattr(generator, "units", None) if units is None else units
        super().__init__(low, high, names=names, units=units)
        if input_times is None:
            input_times = getattr(generator, "input_times", None)
        self.input_times = _grid(input_times, self.rounding)
        self._step = float(self.input_times[1] - self.input_times[0])
        self._amplitude, self._rate, self._duration = amplitude, rate, duration
        self._require_names()
        if self._values is not None:
            self._values = self._values[self.permits(self._values)]
            num, expected = len(self._values), "a recorded signal within its limits"
            advice = "loosen amplitude, rate or duration"
            require(num > 0, expected, f"none of {self}", advice)
        else:
            self.sample((1,), seed=0)

    @override
    def __repr__(self) -> str:
        names = "amplitude", "rate", "duration"
        limits = zip(names, (self._amplitude, self._rate, self._duration), strict=True)
        given = [f"{name}={value}" for name, value in limits if value]
        inside = super().__repr__().removeprefix("BoxActions(").removesuffix(")")
        return f"SignalActions({', '.join([inside, *given])})"

    def inputs(self, action: Tensor) -> dict[str, Tensor]:
        """Return the signals to play on the grid ``input_times``, by name.

        Args:
            action: Actions, shape (n, action_dim) for series (n, m), or (action_dim,)
                for (m,).

        Raises:
            ValueError: If the generator gives another shape, or no numbers.
        """
        action = torch.as_tensor(action)
        if not action.is_floating_point():
            action = action.float()
        rows = action.reshape(-1, self.action_dim)
        found = self.generator(rows.clone(), self.input_times.to(rows.dtype))
        series = found if isinstance(found, Mapping) else {"input": found}
        shape = (len(rows), len(self.input_times))
        played = {}
        for name, value in series.items():
            tensor = torch.as_tensor(value).to(rows.dtype)
            if tensor.shape != shape or not bool(tensor.isfinite().all()):
                what = "NaN or inf" if tensor.shape == shape else tuple(tensor.shape)
                raise ValueError(
                    f"expected finite signals of shape {shape} of input {name!r}; got "
                    f"{what}; return one row an action, one value a time"
                )
            played[name] = tensor if action.ndim > 1 else tensor[0]
        return played

    @override
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        num = math.prod(sample_shape)
        if self._values is not None:
            with forked_generators(seed):
                at = torch.randint(len(self._values), (num,))
            return self._values[at].reshape(*sample_shape, self.action_dim)
        kept, left = [torch.empty(0, self.action_dim)], num
        with forked_generators(seed):
            for tries in range(self.patience + num):
                drawn = super().sample((max(self.batch, left),))
                drawn = drawn[self.permits(drawn)][:left]
                kept.append(drawn)
                left -= len(drawn)
                if left == 0 or (tries >= self.patience and left == num):
                    break
        if left:
            raise ValueError(
                f"expected actions whose signals keep their limits; got none among "
                f"{self.patience * self.batch} of {self}; loosen amplitude, rate or "
                "duration, or narrow low and high to about what is permitted"
            )
        return torch.cat(kept).reshape(*sample_shape, self.action_dim)

    @override
    def contains(self, action: Tensor) -> Tensor:
        action = torch.as_tensor(action, dtype=torch.float32)
        inside = super().contains(action)
        if self._values is not None:
            near = torch.isclose(action[..., None, :], self._values)
            return inside & near.all(-1).any(-1)
        found = inside.clone()
        found[inside] = self.permits(action[inside])
        return found

    @override
    def permits(self, action: Tensor) -> Tensor:
        inside = torch.ones(len(action)).bool()
        if not len(action):
            return inside
        for name, u in self.inputs(action.double()).items():
            low, high = _both(_of(self._amplitude, name))
            sizes = [abs(x) for x in (low, high) if math.isfinite(x)]
            slack = self.rounding * max(sizes, default=0)
            inside &= (u >= low - slack).all(1) & (u <= high + slack).all(1)
            most = _of(self._rate, name)
            if most is not None:
                change = u.diff(dim=1).abs().amax(1) / self._step
                inside &= change <= (1 + self.rounding) * most
        if self._duration is not None:
            short, long = _both(self._duration)
            time = self._durations(action)
            slack = self.rounding * self._step
            inside &= (time >= short - slack) & (time <= long + slack)
        return inside

    @override
    def listed(self) -> Tensor | None:
        return self._values

    def _durations(self, action: Tensor) -> Tensor:
        """Return the time from the first to the last value that is not 0, (n,)."""
        series = torch.stack([*self.inputs(action.double()).values()])
        on = (series != 0).any(0)
        place = torch.arange(on.shape[1])
        last = place.where(on, -1).amax(1)
        first = place.where(on, on.shape[1]).amin(1)
        return ((last - first).clamp(min=0) * self._step).double()

    def _require_names(self) -> None:
        """Raise if limits name inputs that the generator does not have."""
        some = self.low if self._values is None else self._values[0]
        known = {*self.inputs(some[None])}
        for limits in (self._amplitude, self._rate):
            unknown = {*limits} - known if isinstance(limits, Mapping) else set()
            expected = f"limits of inputs {', '.join(sorted(known))}"
            got = ", ".join(sorted(unknown))
            require(not unknown, expected, got, "correct the name")


def _of(limits: Any, name: str) -> Any:
    return limits.get(name) if isinstance(limits, Mapping) else limits


def _both(limit: Limit | None) -> tuple[float, float]:
    """Return lowest and highest value."""
    if limit is None:
        return -math.inf, math.inf
    return limit if isinstance(limit, tuple) else (-limit, limit)


def _grid(times: Any, rounding: float) -> Tensor:
    """Return a uniform grid, or raise where it is none."""
    if times is None:
        raise ValueError(
            "expected input_times, the grid of the signal; got none; pass, say, "
            "torch.arange(0, 2, 0.01)"
        )
    grid = own_tensor(times, torch.float64, name="input_times")
    steps = grid.diff() if grid.ndim == 1 else grid[:0]
    uneven = bool(((steps - steps.mean()).abs() > rounding * steps.mean()).any())
    if len(steps) < 1 or uneven or not bool((steps > 0).all()):
        raise ValueError(
            "expected input_times (m,) that increase by one step; got shape "
            f"{tuple(grid.shape)} and steps {steps.tolist()[:6]}; pass a uniform grid"
        )
    return grid
