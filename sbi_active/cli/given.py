"""Objects that options name: simulators, priors, action spaces, tasks, effects."""

from __future__ import annotations

import copy
import importlib
import inspect
import json
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
        folder: Folder where paths begin and modules are looked for first; None is the
            current one, in which no modules are looked for where it is a campaign's.

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
        raise ValueError(
            f"expected {name} to be imported, from {here} or as installed; got "
            f"{type(error).__name__}: {error}{place_of(error)}; correct it"
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
        name: Name among ``TASKS``.
        options: Options, each ``NAME=VALUE``.

    Raises:
        ValueError: If an option has no value, the task has none of that name, or what
            the task needs is not installed or its data are elsewhere.

    Example:
        >>> make_task("numerical", ["variant=sinh"]).variant
        'sinh'
    """
    values = dict(_parse(option) for option in options)
    try:
        return get_task(name, **values)
    except ImportError as error:  # its text has the line that installs it
        raise ValueError(str(error)) from error
    except FileNotFoundError as error:
        raise ValueError(f"{error}, as --option data=FOLDER") from error
    except TypeError as error:
        known = ", ".join(inspect.signature(TASKS[name]).parameters) or "none"
        raise ValueError(
            f"expected options of {name!r} among {known}, of their types; got "
            f"{values} ({error}); correct them"
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


class Problem(NamedTuple):
    """The problem that options declare.

    Attributes:
        simulator: Simulator with its noise.
        prior: Prior of its parameters.
        actions: Permitted actions; None if none were needed.
        effects: Effects that a task's simulator may lack.
    """

    simulator: Any
    prior: Distribution
    actions: Any
    effects: Sequence[Effect] = ()


def problem_of(
    simulator: str | None,
    *,
    task: str | None = None,
    option: Sequence[str] = (),
    prior: str | None = None,
    theta_low: str | None = None,
    theta_high: str | None = None,
    actions: Sequence[str] = (),
    noise: str | None = None,
    needs_actions: bool = True,
) -> Problem:
    """Return the simulator, prior and actions that options of these names give.

    Args:
        simulator: Simulator as MODULE:NAME; None for a task's.
        task: Name of a task, which has all but other actions and noise.
        option: Options of the task, each NAME=VALUE.
        prior: Prior as MODULE:NAME.
        theta_low: Lower bounds of a uniform prior in its place.
        theta_high: Upper bounds of a uniform prior in its place.
        actions: Actions, as :func:`actions_of` takes them.
        noise: Noise, as :func:`with_noise` takes it.
        needs_actions: Whether nothing can be done without them.

    Raises:
        ValueError: If too much or too little is given, or it is not what it has to be.
    """
    if (task is None) == (simulator is None):
        raise ValueError(
            "expected --simulator MODULE:FUNCTION or --task; got both or neither; give "
            "one, as in my_robot.py:simulator"
        )
    if simulator is not None:
        model = simulator_of(simulator, noise)
        bounded = prior_of(prior, theta_low, theta_high)
        space = actions_of(actions) if actions or needs_actions else None
        return Problem(model, bounded, space)
    if prior or theta_low or theta_high:
        raise ValueError(
            f"expected no prior with --task, which has one; got "
            f"{prior or theta_low or theta_high}; drop one of them"
        )
    found = make_task(str(task), option)
    space = actions_of(actions) if actions else found.actions
    model, effects = with_noise(found.simulator, noise), getattr(found, "effects", list)
    return Problem(model, found.prior, space, effects())


def simulator_of(name: str, noise: str | None, folder: str | None = None) -> Any:
    """Return a simulator with the noise of --noise.

    Args:
        name: Name of the simulator, as :func:`load_object` takes it.
        noise: Noise as written; None for the simulator's own.
        folder: Folder where paths begin, see :func:`load_object`.

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
        return _instance(prior, Distribution, "a torch distribution")
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


def _instance(name: str, kind: type, what: str) -> Any:
    found = load_object(name)
    if not isinstance(found, kind):
        raise ValueError(
            f"expected {what}; got {type(found).__name__} under {name}; name another"
        )
    return found


def actions_of(specs: Sequence[str]) -> ActionSpace:
    """Return the action space that --actions names."""
    if not specs:
        raise ValueError(
            "expected --actions; got none; write values as in --actions 0:5:11, one "
            "an entry of the action"
        )
    if names_object(specs):
        return _instance(specs[0], ActionSpace, "a space of sbi_active.actions")
    entries = [_entry(spec) for spec in specs]
    limits = [entry for entry in entries if isinstance(entry, tuple)]
    values = [entry for entry in entries if isinstance(entry, list)]
    if not values:
        low, high = zip(*limits, strict=True)
        return BoxActions([*low], [*high])
    if limits:
        return MixedActions(
            *[
                DiscreteActions(entry, names=[f"action_{k}"])
                if isinstance(entry, list)
                else BoxActions([entry[0]], [entry[1]], names=[f"action_{k}"])
                for k, entry in enumerate(entries)
            ]
        )
    _require_few(math.prod(map(len, values)))
    return DiscreteActions(torch.cartesian_prod(*map(torch.tensor, values)))


def _entry(spec: str) -> tuple[float, float] | list[float]:
    """Return the limits that LOW:HIGH writes, or the values that anything else does."""
    parts = spec.split(":")
    if len(parts) == 1:
        return numbers_of(spec)
    count = int(parts[2]) if len(parts) == 3 and parts[2].isdecimal() else 0
    if len(parts) > 2 and count < 1:
        raise ValueError(
            f"expected LOW:HIGH:COUNT or A,B,...; got {spec!r}; write, say, 0:5:11"
        )
    low, high = map(number_of, parts[:2])
    _require_few(count)
    return torch.linspace(low, high, count).tolist() if count else (low, high)


def _require_few(count: int) -> None:
    if count > MOST_ACTIONS:
        raise ValueError(
            f"expected at most {MOST_ACTIONS} actions; got {count}; write LOW:HIGH for "
            "any number between, or a smaller COUNT"
        )


def effects_of(names: Iterable[str | None], folder: str | None = None) -> list[Effect]:
    """Return effects, each name that of a list or of a function that returns one.

    Args:
        names: Names of the effects, as :func:`load_object` takes them; None is left
            out.
        folder: Folder where paths begin, see :func:`load_object`.

    Raises:
        ValueError: If there are none under a name.
    """
    effects: list[Effect] = []
    for name in filter(None, names):
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
        own: Effects that are declared.
        simulator: Simulator as it was before any effect was adopted.
        space: Actions, or trials with inputs.
        prior: Prior of the simulator's parameters.
    """
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    taken = {effect.name for effect in own}
    generic = generic_effects(simulator, space, prior=prior)
    return [*own, *(effect for effect in generic if effect.name not in taken)]
