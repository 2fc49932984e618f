"""Effects of any black box: of its inputs and outputs, and of its parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, Normal

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.columns import split
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.changes import Wrapped
from sbi_active.criticism.effects.effect import Context, Effect, Hook
from sbi_active.criticism.effects.table import Sizes, Words, rows_of
from sbi_active.criticism.effects.trial_conditions import conditions_for, has_own_times
from sbi_active.expected import require
from sbi_active.seeding import forked_generators, row_seeds
from sbi_active.simulation import SimulatorModel
from sbi_active.support import support_bounds, support_of

TABLE = Path(__file__).with_name("generic.md")
NUM_ACTIONS, NUM_PRIOR = 256, 256
#: Delays, lags and a clock's error, in spans of a recording.
LATE = 0.02


def generic_effects(
    model: SimulatorModel,
    actions: ActionSpace | Trials,
    *,
    prior: Distribution | None = None,
) -> list[Effect]:
    r"""Return effects that wrap the inputs and outputs of a simulator.

    Effects on the action are gain, offset, saturation and, where actions have both
    signs, a dead zone. Effects on the observation are bias, gain, drift with the
    trial's index, an offset of the clock where x has sample times, and saturation where
    the prior is given. Scales come from the range of the actions, the noise, and the
    prior predictive. Noise inflation needs no effect: it is always among the rivals.
    The drift is left out of a comparison with trials whose order is unknown.

    Trials in place of the actions give more effects, and so do the signals of a model.
    An action that is a label, or stands for a signal, is left as it is. Effects on each
    input over time are gain, offset, saturation, dead zone, delay, first-order lag and
    backlash of its actuator, with the input's name where there are several. Where x has
    sample times, a drift along them, delay, first-order lag and quantum of the sensor
    take the place of the clock's offset; up to four sensors have theirs each, with the
    channel's name. Delays and lags are a fiftieth of a recording, and ten samples at
    most.

    Args:
        model: The simulator.
        actions: The permitted actions, or the measured trials.
        prior: Prior of the simulator's parameters, for the spread of its predictions;
            needed if the simulator declares no noise.

    Raises:
        ValueError: If neither noise nor prior says how large x and its errors are.
    """
    is_sized = model.noise is not None or prior is not None
    expected = "a simulator with declared noise, or its prior"
    got = "neither, so nothing says how large a bias may be"
    require(is_sized, expected, got, "give prior=")
    sd = None if model.noise is None else model.noise.declared_sds()
    draws = None if prior is None else _prior_draws(model, actions, prior)
    trials = actions if isinstance(actions, Trials) else None
    times, inputs, grid, signals = model.sample_times, None, None, model.inputs
    if isinstance(actions, Trials):
        inputs, grid, values = actions.inputs, actions.input_times, actions.action
        units = [split(label)[1] for label in actions.action_labels or ()]
        times = times if has_own_times(model, actions) else actions.sample_times
    else:
        values, units = actions.sample((NUM_ACTIONS,), seed=0).double(), actions.units
    if signals is not None and inputs is None:
        inputs, grid = signals.inputs(values), signals.input_times
    found = []
    if signals is None and (trials is None or not trials.action_is_label):
        unit = units[0] if len({*units}) == 1 else ""
        words = {"who": "the action", "before": "", "unit": unit}
        sizes = _command(values.float().double())  # an executed action is single
        found += _made("command", "action", "action", sizes, words)
    if inputs is not None:
        delay = min(typical_delay(t) for t in (grid, times) if t is not None)
        labels = None if trials is None else trials.input_labels
        found += _of_inputs(inputs, labels, delay)
    late: dict[str, Tensor] = {}
    if times is not None:
        far = times.nan_to_num(-torch.inf).max() - times.nan_to_num(torch.inf).min()
        late = {"span": far, "delay": torch.tensor([typical_delay(times)])}
        if trials is None and inputs is None:
            late = {"late": torch.tensor([LATE * float(far)])}
    sensors: list[tuple[str, int | None]] = [("", None)]
    if trials is not None and times is not None:
        num = 1 if trials.x.ndim == 2 else trials.x.shape[2]
        if trials.x.ndim == 3 and 1 < num <= 4:
            names = trials.channel_labels or model.channel_names
            names = names or [f"x {j + 1}" for j in range(num)]
            sensors = [(split(name)[0], j) for j, name in enumerate(names)]
        elif num == 1 and sd is not None:
            sd = sd.mean().reshape(1)  # a sample is no channel
    for name, channel in sensors:
        found += _of_sensor(sd, draws, late, name, channel)
    return found


def typical_delay(times: Tensor) -> float:
    """Return one prior deviation of delays and lags, s, ten samples at most.

    Args:
        times: Sample times of one recording, or of several, shape (k,) or (t, k), NaN
            for none.
    """
    rows = times.reshape(-1, times.shape[-1]).double()
    known = [row[row.isfinite()] for row in rows]
    span = max(float(row.max() - row.min()) for row in known)
    gaps = torch.cat([row.diff() for row in known])
    step = float(gaps[gaps > 0].median()) if bool((gaps > 0).any()) else span
    return min(LATE * span, 10 * step)


def _made(
    of: str, hook: Hook, label: str, sizes: Sizes, words: Words, **wrapped: Any
) -> list[Effect]:
    """Return the effects of the table whose sizes are known."""
    found = []
    for row in rows_of(TABLE):
        if row.of == of and row.is_sized(sizes):
            how: Any = {"needs_order": row.changes == "drift by trial"}
            how["apply"] = Wrapped(row.changes, **wrapped)
            found.append(row.made(label, sizes, words, hook=hook, **how))
    return found


def _command(some: Tensor) -> dict[str, Tensor]:
    """Return sizes of commands, shape (n, k)."""
    low, high = some.min(0).values, some.max(0).values
    width = torch.where(high > low, high - low, high.abs().clamp(min=1e-12))
    sizes = {"one": torch.ones_like(width), "range": width}
    if bool(((low < 0) & (high > 0)).any()):
        sizes["swing"] = width
    return sizes | {"largest": some.abs().max(0).values.clamp(min=1e-12)}


def _of_inputs(
    inputs: Mapping[str, Tensor], labels: Sequence[str] | None, delay: float
) -> list[Effect]:
    """Return effects of an actuator on each input that is not always zero."""
    found = []
    each = zip(inputs.items(), labels or [""] * len(inputs), strict=True)
    for (name, value), label in each:
        if not bool((value != 0).any()):
            continue
        before = name if len(inputs) > 1 else ""
        sizes = _command(value[value.isfinite()].double()[:, None])
        if bool((value.diff(dim=1) != 0).any()):
            sizes |= {"play": sizes["range"], "delay": torch.tensor([delay])}
        unit = split(label)[1]
        words = {"who": f"the input {name}", "before": before, "unit": unit}
        own = before or "input"
        found += _made("command", "input", own, sizes, words, inputs=(name,))
    return found


def _of_sensor(
    sd: Tensor | None,
    draws: tuple[Tensor, Tensor] | None,
    late: Mapping[str, Tensor],
    label: str,
    channel: int | None,
) -> list[Effect]:
    """Return effects on an observation.

    Args:
        sd: Deviations of its noise, None if they are not declared.
        draws: Draws of x, twice; None if no prior is known.
        late: Sizes of what acts in time.
        label: Name of the sensor.
        channel: Entry of x's last axis that it reads; None for all of x.
    """
    if channel is not None:
        sd = None if sd is None else sd[[channel if len(sd) > channel else 0]]
        draws = draws and (draws[0][..., [channel]], draws[1][..., [channel]])
    sizes = dict(late)
    if draws is not None:
        x, again = draws
        finite = x.flatten(1).isfinite().all(-1) & again.flatten(1).isfinite().all(-1)
        within = (x - again)[finite].square().mean().sqrt().reshape(1) / 2**0.5
        # A median: a spread that a few extreme actions make is not the typical one.
        spread = (x[finite] - x[finite].median(0).values).abs().median() * 1.4826
        sizes["spread"] = spread.clamp(min=float(within)).reshape(1)
        sd = within if sd is None else sd
    assert sd is not None
    sizes |= {"noise": sd, "one": torch.ones_like(sd)}
    words = {"at": f"{label}: " if label else ""}
    return _made("sensor", "observation", label, sizes, words, channel=channel)


def _prior_draws(
    model: SimulatorModel, actions: ActionSpace | Trials, prior: Distribution
) -> tuple[Tensor, Tensor]:
    """Return x over the prior, and again at the same parameters."""
    with forked_generators(0, "spread"):
        theta = prior.sample(torch.Size([NUM_PRIOR]))
        run = {}
        if isinstance(actions, Trials):
            rows = torch.arange(NUM_PRIOR) % len(actions)
            action = actions.action[rows].to(theta.dtype)
            run = conditions_for(model, actions, rows, theta.dtype)
        else:
            action = actions.sample((NUM_PRIOR,)).to(theta.dtype)
        x = model(theta, action, seeds=row_seeds(0, NUM_PRIOR), **run)
        again = model(theta, action, seeds=row_seeds(1, NUM_PRIOR), **run)
    return x.double(), again.double()


@dataclass(frozen=True)
class _Varied:
    """Shifts a parameter by phi where a variable is at the end of its range.

    Attributes:
        parameter: Place of the parameter in theta.
        sd: Its prior deviation.
        entry: Entry of the action that it depends on; None for the order of the trials.
        center: Middle of the range of that variable.
        half: Half of this range.
        bounds: Ends of the prior, beyond which the simulator may not be defined.
    """

    parameter: int
    sd: float
    entry: int | None
    center: float
    half: float
    bounds: tuple[float, float]

    def __call__(
        self, theta: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        value = context.index if self.entry is None else action[:, self.entry]
        place = (value.to(theta) - self.center) / self.half
        column = theta[:, self.parameter]
        moved = (column + phi[:, 0] * self.sd * place).clamp(*self.bounds)
        # What lies beyond already, as another effect may make it, is left there.
        theta[:, self.parameter] = torch.where(phi[:, 0] == 0, column, moved)
        return theta


def varying_parameters(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    scale: float = 0.5,
) -> list[Effect]:
    r"""Return effects that make each parameter depend on what the trials show.

    .. math::
        \theta_j \to \theta_j + \phi\, s_j\, z(v), \qquad z \in [-1, 1],

    with the prior deviation :math:`s_j` of the parameter and, in units of the range of
    the trials, an entry of the action or the place v of the trial in their order. A
    friction that grows with speed or a motor that warms up is of this kind. The
    parameter stays within the bounds of its prior. All effects of one parameter are one
    family, which shares a prior probability.

    Args:
        model: The simulator; its ``parameter_names`` name the effects.
        prior: Prior of its parameters.
        trials: Measured trials. Entries of the action that do not differ, and actions
            that are labels, vary nothing; nor does an order that is unknown.
        scale: Prior standard deviation of phi: the change of a parameter, in its own
            prior deviations, from the middle to an end of the range. A third
            and three times are tried as well, so that half or twice says little else.

    Returns:
        Effects for ``close_loop(effects=...)``, up to (action_dim + 1) a parameter.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import SimulatorModel
        >>> from sbi_active.criticism import Trials, varying_parameters
        >>> model = SimulatorModel(lambda theta, v: theta * v, parameter_names=["grip"])
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> trials = Trials(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.9]))
        >>> [effect.name for effect in varying_parameters(model, prior, trials)]
        ['grip by action', 'grip by trial']
    """
    low, high = support_bounds(support_of(prior), prior.event_shape[0])
    with forked_generators(0, "deviations"):
        sd = prior.sample(torch.Size([256])).double().std(0)  # to some 5 %
    names = model.parameter_names or [f"theta_{j + 1}" for j in range(len(sd))]
    effects = []
    for j, name in enumerate(names):
        bounds = float(low[j]), float(high[j])
        for label, unit, entry, center, half in _variables(trials):
            varied = _Varied(j, float(sd[j]), entry, center, half, bounds)
            effects.append(
                Effect(
                    f"{name} by {label}",
                    hook="parameter",
                    prior=Normal(0.0, scale),
                    null=0.0,
                    apply=varied,
                    units="prior sd",
                    family=f"varying {name}",
                    describe=f"{name} changes with {label}{unit}, by phi prior "
                    "deviations from the middle of the range tried to its end",
                    needs_order=entry is None,
                )
            )
    return effects


def _variables(trials: Trials) -> Iterator[tuple[str, str, int | None, float, float]]:
    """Yield name, unit, entry of the action, middle and half range of each variable."""
    dim = trials.action.shape[1]
    plain = ["action"] if dim == 1 else [f"action {k + 1}" for k in range(dim)]
    labels = () if trials.action_is_label else trials.action_labels or plain
    columns: dict[int | None, tuple[str, Tensor]] = {
        entry: (label, trials.action[:, entry]) for entry, label in enumerate(labels)
    }
    if trials.order != "unknown":
        columns[None] = "trial", trials.index
    for entry, (label, column) in columns.items():
        low, high = float(column.min()), float(column.max())
        if high > low:
            name, unit = split(label)
            unit = f" ({unit})" if unit else ""
            yield name, unit, entry, (low + high) / 2, (high - low) / 2
