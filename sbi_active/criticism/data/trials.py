"""Measured trials: actions, observations and what is known of each."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import torch
from torch import Tensor

from sbi_active.arrays import measured
from sbi_active.criticism.data.arrays import (
    Role,
    kept,
    one_each,
    padded,
    repeated,
    root,
    rows_at,
    rows_joined,
    sample_times_of,
    texts,
    without_inf,
)
from sbi_active.criticism.data.input_series import Hold, inputs_of
from sbi_active.criticism.data.tables import read_trials
from sbi_active.expected import require, suggests

Order = Literal["known", "unknown"]


class Trials:
    r"""Measured trials.

    Ragged observations are padded with NaN. NaN is masked, and so is inf, with a
    warning; a trial of NaN alone is *invalid*: the system ran and gave no measurement.
    All arguments are copied, and may change afterwards.

    Args:
        action: Actions as commanded, shape (n, action_dim), or (n,) for scalar ones.
            None if the inputs say what was commanded: the action is then the trial's
            number, a label that no effect changes.
        x: Shape (n, \*x_shape), or a list of n arrays of shape (k_i, \*channels).
        role: "fit", or "held out" of everything that is fitted or chosen; one a
            trial, or None for all "fit".
        mask: Mask of x, true where it is a measurement; None takes all that is not NaN.
        index: Place of each trial in the order of execution, shape (n,); None counts
            from 0.
        order: "known", or "unknown" where the index does not say when a trial was
            executed: nothing is then traced to wear or drift from trial to trial.
        sample_times: Times of x's first axis, shape (k,), (n, k), or a list of n.
        names: Names of the trials in reports; None takes their indices.
        repeat_of: Position of the trial that each one repeats, (n,), -1 for none; None
            takes trials of equal actions. A repeat of a repeat is one of the first.
        action_labels: Labels of the action's entries in reports, with units.
        channel_labels: Labels of the entries of x's last axis, likewise.
        inputs: Signals over time, {name: series}, each of shape (n, m), (m,) where all
            trials share it, or a list of n arrays.
        input_times: Times of the inputs, shape (m,), (n, m), a list of n, or such by
            name, from the same origin as ``sample_times``, which they are where there
            are as many.
        input_hold: Value of an input between its times: the "previous" one, as commands
            are held, or "linear".
        input_labels: Labels of the inputs in reports, with units.
        start: Measured start state, {name: (n,)}.

    Attributes:
        inputs: Inputs by name, shape (n, m), on one uniform grid for all trials: its
            step is the smallest median step of a trial, and before and after a trial's
            own times its first and last value are held. None if there are none.
        input_times: The grid, shape (m,).
        action_is_label: Whether the action is only the trial's number.

    Raises:
        ValueError: If shapes disagree, numbers are not real, actions, inputs, start
            states or the index not finite, all trials are invalid, held-out data have
            no measurement, or inputs have a gap or do not cover what was measured.

    Example:
        >>> trials = Trials(torch.tensor([1.0, 2.0]), torch.tensor([0.3, 0.5]))
        >>> len(trials), trials.action.shape, trials.x.shape
        (2, torch.Size([2, 1]), torch.Size([2, 1]))

        A motor's position every .5 s, its voltage every .1 s:

        >>> voltage, position = torch.randn(3, 21), torch.randn(3, 5)
        >>> trials = Trials(
        ...     None, position, sample_times=torch.linspace(0, 2, 5),
        ...     inputs={"voltage": voltage}, input_times=torch.linspace(0, 2, 21),
        ... )
        >>> trials.action[:, 0].tolist(), trials.inputs["voltage"].shape
        ([0.0, 1.0, 2.0], torch.Size([3, 21]))
    """

    @suggests
    def __init__(
        self,
        action: Any,
        x: Any,
        *,
        role: Sequence[Role] | None = None,
        mask: Any = None,
        index: Any = None,
        order: Order = "known",
        sample_times: Any = None,
        names: Sequence[object] | None = None,
        repeat_of: Any = None,
        action_labels: Sequence[str] | None = None,
        channel_labels: Sequence[str] | None = None,
        inputs: Any = None,
        input_times: Any = None,
        input_hold: Hold = "previous",
        input_labels: Sequence[str] | None = None,
        start: Any = None,
    ) -> None:
        self.x = padded(x)
        n = len(self.x)
        self.action_is_label = action is None
        if action is None:
            given = inputs is not None or start is not None
            expected = "actions, or inputs over time in their place"
            require(given, expected, "neither", "pass what was commanded in each trial")
            action, action_labels = torch.arange(n), action_labels or ["trial"]
        self.action = measured(action, name="action")
        if self.action.ndim == 1:
            self.action = self.action[:, None]
        shape, lost = tuple(self.action.shape), int((~self.action.isfinite()).sum())
        is_one_each = len(shape) == 2 and shape[0] == n and 0 not in shape and not lost
        expected = "finite actions (n, action_dim) and x with as many rows"
        got = f"{shape} with {lost} that are not finite, and {tuple(self.x.shape)}"
        require(is_one_each, expected, got, "give each trial what was commanded")
        if self.x.ndim == 1:
            self.x = self.x[:, None]
        if mask is not None:
            self.x = self.x.where(kept(mask, self.x), torch.nan)
        each = ["fit"] * n if role is None else role
        self.role: list[Any] = [str(one).replace("_", " ") for one in each]
        is_known = len(self.role) == n and {*self.role} <= {"fit", "held out"}
        expected = f"a role 'fit' or 'held out' for each of {n} trials"
        require(is_known, expected, self.role, "give one each")
        self.index = one_each("index", range(n) if index is None else index, n)
        known = "order 'known' or 'unknown'"
        require(order in ("known", "unknown"), known, repr(order), "pass one of them")
        self.order: Order = order
        expected = f"names of {n} trials, each another"
        self._names = texts(expected, names, [n], distinct=True)
        self.x = without_inf(self.x, self.names)
        self.sample_times = sample_times_of(sample_times, self.x, self.names)
        self.inputs, self.input_times = inputs_of(
            inputs, input_times, input_hold, self.x, self.sample_times, self.names
        )
        is_named = start is None or isinstance(start, Mapping)
        expected = "start states as {name: (n,)}"
        require(is_named, expected, type(start), "name each of them")
        advice = "leave these out, or declare an effect of scope 'trial' in its place"
        given = (start or {}).items()
        parts = {str(k): one_each(str(k), v, n, advice) for k, v in given}
        self.start: dict[str, Tensor] | None = parts or None
        self.repeat_of = repeated(self.settings())
        if repeat_of is not None:
            self.repeat_of = root(one_each("repeat_of", repeat_of, n))
        # A trajectory of one channel has no axis for it.
        one = [1] if self.x.ndim == 2 and self.sample_times is not None else []
        self.action_labels, self.input_labels, self.channel_labels = (
            texts(f"{name}_labels of {sizes[0]} strings, one an entry", labels, sizes)
            for name, labels, sizes in (
                ("action", action_labels, [self.action.shape[1]]),
                ("input", input_labels, [len(self.inputs or ())]),
                ("channel", channel_labels, [self.x.shape[-1], *one]),
            )
        )
        got, is_any = f"{n} trials without a measurement", bool(self.valid.any())
        require(is_any, "at least one valid trial", got, "check x and mask for NaN")
        lost = [i for i in self.held_out_positions if not bool(self.valid[i])]
        expected, got = "measurements in the held-out trials", self.called(lost)
        require(not lost, expected, f"NaN in {got}", "hold out other trials")

    @classmethod
    def from_csv(
        cls,
        path: str | Path | pd.DataFrame,
        *,
        columns: Mapping[str, str | Sequence[str]] | None = None,
        units: Mapping[str, str] | None = None,
        order: Order = "known",
        inputs: str | Path | pd.DataFrame | None = None,
        input_hold: Hold = "previous",
    ) -> Trials:
        r"""Return the trials of a CSV file with one row a trial or one row a sample.

        A row is a sample where there are columns "trial" and "time" (in s, or as in
        "time_ms"). Either way "action_\*" is the action, which like all else that
        belongs to a trial stands in each of its rows, and "x_\*" the observation.
        Reports name a trial by its entry in "trial".
        Optional are "role", "index" (the place in the order of execution; without it
        that of the first row) and "repeat_of" (the index of the trial that is
        repeated). An empty cell of x is what was not measured. A unit stands in
        brackets: "x_height[mm]" becomes m, as reports say. "start_\*" is the measured
        start state. "input_\*" varies within a trial, in a table with one row a sample,
        which then needs no action; rows may have an input and no x.

        Args:
            path: Path of a file, in which lines after # are comments, or a folder with
                ``trials.csv`` or such files: one with times and no "trial" is a trial.
            columns: Names of the columns that are "trial", "time", "action", "x",
                "input", "start", "role", "index" and "repeat_of", where they have other
                names; those left out are then ignored. Several columns may name a trial
                together.
            units: Units by column, where the header has none. Numbers become SI, such
                as ms, mm and deg; what is not known, such as px, stays as it is.
            order: Order of execution; "unknown" where rows are in any order.
            inputs: Another file, or a data frame, with the inputs at times of their
                own: "time", "input_\*", and "trial" unless all trials share them. Names
                in columns and units hold in either table.
            input_hold: Value of an input between two times, as in the constructor.

        Raises:
            ValueError: If the table is not understood; the text says where.
        """
        found = read_trials(path, columns, units, inputs)
        return cls(**found, order=order, input_hold=input_hold)

    @classmethod
    def from_dataframe(cls, frame: pd.DataFrame, **options: Any) -> Trials:
        """Return the trials of a data frame, laid out as for :meth:`from_csv`.

        Args:
            frame: Table with one row a trial or one row a sample.
            **options: Options of :meth:`from_csv`.

        Example:
            >>> columns = {"ball": ["a", "a", "b"], "t": [0, 1, 0], "h": [3.0, 2, 4]}
            >>> frame = pd.DataFrame({**columns, "mass": [0.1, 0.1, 0.2]})
            >>> trials = Trials.from_dataframe(
            ...     frame,
            ...     columns={"trial": "ball", "time": "t", "x": "h", "action": "mass"},
            ...     units={"h": "m"},
            ... )
            >>> trials.x.shape, trials.channel_labels
            (torch.Size([2, 2]), ('h [m]',))
        """
        return cls.from_csv(frame, **options)

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        held = len(self.held_out_positions)
        return (
            f"Trials({len(self)} x {tuple(self.x.shape[1:])}, {held} held out, "
            f"{int((~self.valid).sum())} invalid)"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the trials, as given, or their indices."""
        return self._names or tuple(f"{value:.15g}" for value in self.index.tolist())

    def called(self, positions: Sequence[int]) -> str:
        """Return trials in words, as in "trials a, b"."""
        which = ", ".join(self.names[i] for i in positions)
        return f"trial{'s' * (len(positions) != 1)} {which}"

    @property
    def mask(self) -> Tensor:
        """True if x is a measurement, of the shape of x."""
        return self.x.isfinite()

    @property
    def valid(self) -> Tensor:
        """Trials with a measurement, shape (n,), bool."""
        return self.mask.flatten(1).any(-1)

    @property
    def held_out_positions(self) -> list[int]:
        """Positions of the held-out trials."""
        return [i for i, role in enumerate(self.role) if role == "held out"]

    @property
    def fit(self) -> Trials:
        """The trials that may be fitted."""
        is_fit = torch.tensor([role == "fit" for role in self.role])
        require(bool(is_fit.any()), "a trial of role 'fit'", "none", "change a role")
        return self.select(is_fit)

    @property
    def held_out(self) -> Trials | None:
        """The held-out trials; None if there are none."""
        held = self.held_out_positions
        return self.select(held) if held else None

    def template(self) -> tuple[Tensor, Tensor | None]:
        """Return a trial in which all is measured that any trial has, and its times.

        Returns:
            Zeros of the shape of one x, NaN where the longest trial has no sample; its
            sample times, shape (k,), NaN there too, or None.
        """
        x, times = torch.zeros_like(self.x[0]), self.sample_times
        if times is None:
            return x, None
        # A sample that no trial has, such as one thinned out, is none.
        seen = self.mask.reshape(*self.x.shape[:2], -1).any(-1).any(0)
        if times.ndim > 1:
            times = times[int(times.isfinite().sum(-1).argmax())]
            seen = seen & times.isfinite()
        return x.where(seen.reshape(-1, *[1] * (x.ndim - 1)), torch.nan), times

    def select(self, positions: Any) -> Trials:
        """Return some trials, with their indices.

        Args:
            positions: A slice, positions, or a bool a trial.
        """
        at = torch.arange(len(self))[
            positions if isinstance(positions, slice) else torch.as_tensor(positions)
        ].reshape(-1)
        own = torch.arange(len(self))
        first = torch.where(self.repeat_of < 0, own, self.repeat_of)[at]
        some = copy.copy(self)
        for name in self._by_trial():
            setattr(some, name, rows_at(getattr(self, name), at))
        some.role = [self.role[i] for i in at]
        some.repeat_of = repeated(first[:, None])
        if self._names is not None:  # of trials that may be there twice now
            some._names = tuple(self._names[i] for i in at)
        return some

    __getitem__ = select

    def joined(self, further: Trials) -> Trials:
        """Return these trials with further ones of the same machine behind them."""
        both, others = copy.copy(self), copy.copy(further)
        if others.sample_times is not None:
            others.sample_times = others.sample_times.expand(len(others), -1)
        for name in self._by_trial():
            parts = getattr(self, name), getattr(others, name)
            setattr(both, name, rows_joined(*parts))
        both.role = [*self.role, *further.role]
        if self._names is not None:
            new = [f"new {n}" if n in self._names else n for n in further.names]
            both._names = (*self._names, *new)
        both.repeat_of = repeated(both.settings())
        return both

    def _by_trial(self) -> list[str]:
        """Return the names of the attributes that have a row a trial."""
        times = self.sample_times
        own = ["sample_times"] if times is not None and times.ndim > 1 else []
        return ["action", "x", "index", "inputs", "start", *own]

    def settings(self) -> Tensor:
        """Return all that was set in each trial, shape (n, k); a label is not."""
        parts = [] if self.action_is_label else [self.action]
        parts += (self.inputs or {}).values()
        parts += [value[:, None] for value in (self.start or {}).values()]
        return torch.cat(parts, -1)
