"""What options name: objects, simulators, priors, spaces of actions, tasks, effects."""

from __future__ import annotations

import copy
import importlib
import inspect
import json
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution

from sbi_active.actions import (
    ActionSpace,
    BoxActions,
    DiscreteActions,
    MixedActions,
)
from sbi_active.cli.declared import in_campaign, names_object
from sbi_active.cli.options import number_of, numbers_of
from sbi_active.cli.output import place_of
from sbi_active.criticism import Effect, generic_effects
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks import TASKS, Task, get_task  # pyright: ignore

#: Actions of one space. A choice: each is stored in the campaign's folder and takes
#: part in each design; twice as many take twice the memory, and half are still more
#: than any design tells apart.
MOST_ACTIONS = 100_000


def load_object(name: str, folder: str | None = None) -> Any:
    """Import what a user names.

    Args:
        name: ``module:attribute``, or ``path/file.py:attribute``.
        folder: Where paths begin and modules are looked for first; None is the current
            one, in which no modules are looked for where it is a campaign's.

    Raises:
        ValueError: If there is no such module or attribute, or it cannot be imported.
    """
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError(
            f"expected MODULE:NAME; got {name!r}; write, say, my_robot:simulator"
        )
    file, here = None, Path.cwd() if folder is None else Path(folder)
    if module.endswith(".py"):
        file = Path(here, module).resolve()
        if not file.is_file():
            raise ValueError(f"expected a file; got none at {file}; check the path")
        sys.path.insert(0, str(file.parent))
        module = file.stem
    if str(here) not in sys.path and (folder is not None or not in_campaign(here)):
        sys.path.insert(0 if file is None else len(sys.path), str(here))
    try:
        loaded = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        lacks = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
        if lacks and lacks.partition(".")[0] == module.partition(".")[0]:
            raise ValueError(
                f"expected a module {module!r}; got none in {here} or among the "
                "installed ones; run where it lies, or install it"
            ) from error
        raise ValueError(
            f"expected {name} to be imported; got {type(error).__name__}: {error}"
            f"{place_of(error)}; correct it"
        ) from error
    origin = getattr(loaded, "__file__", None)
    if file is not None and (origin is None or Path(origin).resolve() != file):
        raise ValueError(
            f"expected a file whose name no other module has; got {file.name}, which "
            f"is also {origin or 'built in'}; rename the file"
        )
    try:
        return getattr(loaded, attribute)
    except AttributeError as error:
        raise ValueError(
            f"expected {attribute!r} in module {module!r}; got none; choose among "
            f"{', '.join(n for n in vars(loaded) if not n.startswith('_'))}"
        ) from error


def make_task(name: str, options: Sequence[str]) -> Task:
    """Return a task with the options of a command line.

    Args:
        name: One of ``TASKS``.
        options: Each ``NAME=VALUE``.

    Raises:
        ValueError: If an option has no value, the task has none of that name, or what
            the task needs is not installed or its data are elsewhere.

    Example:
        >>> make_task("numerical", ["variant=sinh"]).variant
        'sinh'
    """
    values = dict(_parse(option) for option in options)
    if name in TASKS:
        known = [*inspect.signature(TASKS[name]).parameters]
        unknown = [option for option in values if option not in known]
        if unknown:
            raise ValueError(
                f"expected options of {name!r} among {', '.join(known) or 'none'}; got "
                f"{unknown[0]!r}; drop it or choose one of these"
            )
    try:
        return get_task(name, **values)
    except ImportError as error:  # its text has the line that installs it
        raise ValueError(str(error)) from error
    except FileNotFoundError as error:
        raise ValueError(f"{error}, as --option data=FOLDER") from error
    except TypeError as error:
        raise ValueError(
            f"expected values that {name!r} can use; got {values} ({error}); "
            "correct the types"
        ) from error


def _parse(option: str) -> tuple[str, Any]:
    name, separator, text = option.partition("=")
    if not separator or not name:
        raise ValueError(
            f"expected --option NAME=VALUE; got {option!r}; write, say, target=2"
        )
    try:
        return name, json.loads(text)
    except json.JSONDecodeError:
        return name, text


def simulator_of(name: str, noise: str | None, folder: str | None = None) -> Any:
    """Return a simulator with the noise of --noise.

    Args:
        name: As :func:`load_object` takes it.
        noise: As written; None for the simulator's own.
        folder: As there.

    Raises:
        ValueError: If it is not there, or no function.
    """
    found = load_object(name, folder)
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{name}; name what takes (theta, action)"
        )
    return with_noise(found, noise)


def with_noise(simulator: Any, text: str | None) -> Any:
    """Return a simulator with the Gaussian noise that --noise gives; None for none."""
    if text is None:
        return simulator
    sd = numbers_of(text)
    if min(sd) <= 0:
        raise ValueError(
            f"expected --noise > 0; got {text}; give the standard deviation of a "
            "measurement"
        )
    noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    if not isinstance(simulator, SimulatorModel):
        return SimulatorModel(simulator, noise=noise)
    noisy = copy.copy(simulator)
    noisy.noise = noise
    return noisy


def prior_of(
    prior: str | None, theta_low: str | None, theta_high: str | None
) -> Distribution:
    """Return the prior that --prior, or --theta-low and --theta-high, name."""
    if prior is not None:
        return _instance(prior, Distribution, "a torch distribution; name a prior")
    if theta_low is None or theta_high is None:
        raise ValueError(
            "expected --theta-low and --theta-high, or --prior; got too few; give "
            "bounds as in --theta-low=0,-1 --theta-high=1,1"
        )
    low, high = numbers_of(theta_low), numbers_of(theta_high)
    if len(low) != len(high) or any(a >= b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"expected as many bounds, low below high; got {low} and {high}; give "
            "one of each a parameter"
        )
    return BoxUniform(torch.tensor(low), torch.tensor(high))


def _instance(name: str, kind: type, expected: str) -> Any:
    found, (what, _, rest) = load_object(name), expected.partition(";")
    if not isinstance(found, kind):
        got = f"got {type(found).__name__} under {name}"
        raise ValueError(f"expected {what}; {got};{rest}")
    return found


def actions_of(specs: Sequence[str]) -> ActionSpace:
    """Return the action space that --actions names."""
    if not specs:
        raise ValueError(
            "expected --actions; got none; write values as in --actions 0:5:11, one "
            "an entry of the action"
        )
    if names_object(specs):
        what = "an action space; name one of sbi_active.actions"
        return _instance(specs[0], ActionSpace, what)
    ranges = [_range(spec) for spec in specs]
    if None not in ranges:
        low, high = zip(*[limits for limits in ranges if limits], strict=True)
        return BoxActions([*low], [*high])
    if any(ranges):
        parts = [(f"action_{k}", spec) for k, spec in enumerate(specs)]
        return MixedActions(
            *[
                BoxActions(*[[limit] for limit in limits], names=[name])
                if limits
                else DiscreteActions(_axis(spec), names=[name])
                for (name, spec), limits in zip(parts, ranges, strict=True)
            ]
        )
    axes = [torch.tensor(_axis(spec)) for spec in specs]
    _require_few(math.prod(map(len, axes)))
    return DiscreteActions(torch.cartesian_prod(*axes))


def _range(spec: str) -> tuple[float, float] | None:
    """Return the limits that LOW:HIGH writes; None for anything else."""
    if spec.count(":") != 1:
        return None
    low, high = map(number_of, spec.split(":"))
    return low, high


def _axis(spec: str) -> list[float]:
    parts = spec.split(":")
    if len(parts) == 1:
        return numbers_of(spec)
    if len(parts) != 3 or not parts[2].isdecimal() or int(parts[2]) < 1:
        raise ValueError(
            f"expected LOW:HIGH:COUNT or A,B,...; got {spec!r}; write, say, 0:5:11"
        )
    low, high = map(number_of, parts[:2])
    _require_few(int(parts[2]))
    return torch.linspace(low, high, int(parts[2])).tolist()


def _require_few(count: int) -> None:
    if count > MOST_ACTIONS:
        raise ValueError(
            f"expected at most {MOST_ACTIONS} actions; got {count}; write LOW:HIGH for "
            "any number between, or a smaller COUNT"
        )


def effects_of(names: Sequence[str], folder: str | None = None) -> list[Effect]:
    """Return effects, each name that of a list or of a function that returns one.

    Args:
        names: As :func:`load_object` takes them.
        folder: As there.

    Raises:
        ValueError: If there are none under a name.
    """
    effects: list[Effect] = []
    for name in names:
        listed: Any = load_object(name, folder)
        if callable(listed):
            listed = listed()
        found = [*listed] if isinstance(listed, Iterable) else [listed]
        wrong = [e for e in found if not isinstance(e, Effect)]
        if wrong:
            raise ValueError(
                f"expected a list of Effect under {name}; got "
                f"{type(wrong[0]).__name__} in it; declare sbi_active.criticism.Effect"
            )
        effects += found
    return effects


def with_generic(
    own: Sequence[Effect], simulator: Any, space: Any, prior: Distribution
) -> list[Effect]:
    """Return effects and the generic ones of other names.

    Args:
        own: Declared ones.
        simulator: As it was before any was adopted.
        space: Actions, or trials with inputs.
        prior: Of the simulator's parameters.
    """
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    taken = {effect.name for effect in own}
    generic = generic_effects(simulator, space, prior=prior)
    return [*own, *(effect for effect in generic if effect.name not in taken)]
