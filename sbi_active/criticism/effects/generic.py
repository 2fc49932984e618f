"""Effects of any black box: what its inputs and outputs may lack."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Uniform

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.changes import (
    add,
    clamp_log,
    drift,
    scale,
    shift_in_time,
)
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.generic_series import (
    SCALES,
    normal,
    of_actuator,
    of_inputs,
    of_samples,
    on_channel,
    typical_delay,
)
from sbi_active.criticism.effects.trial_conditions import (
    conditions_for,
    has_own_times,
)
from sbi_active.seeding import forked_generators, row_seeds
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.noise.base import declared_sds

NUM_ACTIONS, NUM_PRIOR = 256, 256
#: Sensors along a trajectory that have effects each for itself.
MOST_SENSORS = 4


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
    if model.noise is None and prior is None:
        raise ValueError(
            "expected a simulator with declared noise, or its prior; got neither, so "
            "nothing says how large a bias may be; give prior="
        )
    sd = None if model.noise is None else declared_sds(model.noise)
    draws = None if prior is None else _prior_draws(model, actions, prior)
    if isinstance(actions, Trials):
        return _of_trials(model, actions, sd, draws)
    sd, spread = _sizes(sd, draws)
    if model.inputs is not None:
        signals = model.inputs.inputs(actions.sample((NUM_ACTIONS,), seed=0).double())
        grid, times = model.inputs.input_times, model.sample_times
        found = [*_of_series(signals, grid, times), *_of_observation(sd, spread, None)]
        return found if times is None else [*found, *of_samples(sd, times)]
    return [*_of_action(actions), *_of_observation(sd, spread, model.sample_times)]


def _of_trials(
    model: SimulatorModel,
    trials: Trials,
    sd: Tensor | None,
    draws: tuple[Tensor, Tensor] | None,
) -> list[Effect]:
    times = trials.sample_times
    if has_own_times(model, trials):
        times = model.sample_times
    found, inputs, grid = [], trials.inputs, trials.input_times
    if inputs is None and model.inputs is not None:
        inputs = model.inputs.inputs(trials.action)
        grid = model.inputs.input_times
    if not trials.action_is_label and model.inputs is None:
        labels = trials.action_labels or ()
        units = [label.partition(" [")[2].removesuffix("]") for label in labels]
        recorded = trials.action.unique(dim=0)
        found += _of_action(DiscreteActions(recorded, units=units or None))
    if inputs is not None:
        assert grid is not None
        found += _of_series(inputs, grid, times, trials.input_labels)
    return [*found, *_of_sensors(trials, sd, draws, times, model.channel_names)]


def _of_sensors(
    trials: Trials,
    sd: Tensor | None,
    draws: tuple[Tensor, Tensor] | None,
    times: Tensor | None,
    names: Sequence[str] | None,
) -> list[Effect]:
    """Return effects of one sensor, or of each where few have a series of their own."""
    if times is None:
        return _of_observation(*_sizes(sd, draws), None)
    num = 1 if trials.x.ndim == 2 else trials.x.shape[2]
    if num == 1 or trials.x.ndim > 3 or num > MOST_SENSORS:
        if num == 1 and sd is not None:
            sd = sd.mean().reshape(1)  # a sample is no channel
        sd, spread = _sizes(sd, draws)
        return [*_of_observation(sd, spread, None), *of_samples(sd, times)]
    labels = trials.channel_labels or names or [f"x {j + 1}" for j in range(num)]
    found = []
    for j, label in enumerate(labels):
        own = None if sd is None else sd[[j if len(sd) == num else 0]]
        part = None
        if draws is not None:
            part = draws[0][..., [j]], draws[1][..., [j]]
        own, spread = _sizes(own, part)
        name = label.partition(" [")[0]
        each = [*_of_observation(own, spread, None), *of_samples(own, times)]
        found += [on_channel(effect, j, name) for effect in each]
    return found


def _of_series(
    inputs: dict[str, Tensor],
    grid: Tensor,
    times: Tensor | None,
    labels: Sequence[str] | None = None,
) -> list[Effect]:
    delay = typical_delay(grid)
    if times is not None:
        delay = min(delay, typical_delay(times))
    stated = labels or [""] * len(inputs)
    units = [label.partition(" [")[2].removesuffix("]") for label in stated]
    return of_inputs(inputs, delay, dict(zip(inputs, units, strict=True)))


def _of_action(actions: ActionSpace) -> list[Effect]:
    some = actions.sample((NUM_ACTIONS,), seed=0).double()
    units = actions.units[0] if len({*actions.units}) == 1 else ""
    make = partial(Effect, hook="action", units=units)
    return of_actuator(make, some, "action ", "", "the action")


def _of_observation(
    sd: Tensor, spread: Tensor | None, times: Tensor | None
) -> list[Effect]:
    make = partial(Effect, hook="observation", null=0.0)
    found = [
        make(
            "bias",
            prior=normal(SCALES.bias * sd),
            apply=add,
            describe="the sensor reads a constant too much",
        ),
        make(
            "sensor gain",
            prior=normal(torch.full_like(sd, SCALES.gain)),
            apply=scale,
            describe="the sensor reads a multiple of the truth",
        ),
        make(
            "drift",
            prior=normal(SCALES.drift * sd),
            apply=drift,
            units="a trial",
            describe="the sensor's bias grows from trial to trial",
            needs_order=True,
        ),
    ]
    if times is not None:
        span = float(times.max() - times.min())
        found.append(
            make(
                "clock offset",
                prior=normal(torch.tensor([SCALES.late * span]).double()),
                apply=shift_in_time,
                units="s",
                describe="the time stamps are late by a constant",
            )
        )
    if spread is not None:
        low, high = (torch.log(f * spread.reshape(1)) for f in SCALES.range)
        found.append(
            make(
                "sensor saturation",
                prior=Independent(Uniform(low, high), 1),
                null=torch.inf,
                apply=clamp_log,
                units="log",
                describe="readings beyond a limit are that limit",
            )
        )
    return found


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


def _sizes(
    sd: Tensor | None, draws: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor | None]:
    """Return deviations of the noise, and of x over the prior where that is known."""
    if draws is None:
        assert sd is not None
        return sd, None
    x, again = draws
    finite = x.flatten(1).isfinite().all(-1) & again.flatten(1).isfinite().all(-1)
    within = (x - again)[finite].square().mean().sqrt().reshape(1) / 2**0.5
    # A median: a spread that a few extreme actions make is not the typical one.
    spread = (x[finite] - x[finite].median(0).values).abs().median() * 1.4826
    return within if sd is None else sd, spread.clamp(min=float(within))
