"""Objects that options name: simulators, priors, action spaces, tasks, effects."""

from __future__ import annotations

import copy
import importlib
import inspect
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, BoxActions, DiscreteActions, MixedActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.declare import as_json, number_of, pairs_of
from sbi_active.cli.output import place_of
from sbi_active.cli.trusted import (
    absolute,
    in_campaign,
    names_object,
    read_declared,
    require_trust,
)
from sbi_active.criticism import Effect, generic_effects
from sbi_active.expected import require
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks import TASKS, Task, get_task  # pyright: ignore

#: Actions of one space. A choice: each is stored in the campaign's folder and takes
#: part in each design; twice as many take twice the memory, and half are still more
#: than any design tells apart.
MOST_ACTIONS = 100_000


def load_object(name: str, folder: str | None = None, kind: Any = object) -> Any:
    """Import what a user names.

    Args:
        name: ``module:attribute``, or ``path/file.py:attribute``.
        folder: Folder where paths begin and modules are looked for first; None is the
            current one, in which no modules are looked for where it is a campaign's.
        kind: Class that it has to be of.

    Raises:
        ValueError: If there is no such module or attribute, it cannot be imported, or
            it is of another class.
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
    found = vars(loaded).get(attribute)
    if found is None or not isinstance(found, kind):
        raise ValueError(
            f"expected a {kind.__name__} under {attribute!r} in {module!r}; got "
            f"{type(found).__name__}; choose among "
            f"{', '.join(n for n in vars(loaded) if not n.startswith('_'))}"
        )
    return found


def campaign_options(texts: Sequence[str]) -> CampaignOptions:
    """Return the options of a campaign that --set gives."""
    options = CampaignOptions()
    for name, text in pairs_of(texts).items():
        options = _changed(options, name, as_json(text))
    return options


def _changed(settings: Any, name: str, value: Any) -> Any:
    """Return settings with a field of another value, or with a field of a field."""
    field, point, rest = name.partition(".")
    known = getattr(settings, "__dataclass_fields__", {})
    if field not in known:
        raise ValueError(
            f"expected a setting among {', '.join(known) or 'none'}; got {name}; write "
            "one of these"
        )
    part = _changed(getattr(settings, field), rest, value) if point else value
    try:
        return replace(settings, **{field: part})
    except TypeError as error:
        raise ValueError(
            f"expected another {name}; got {value!r} ({error}); correct it"
        ) from error


def task_of(name: str, texts: Sequence[str]) -> Task:
    """Return a task with the options of a command line.

    Args:
        name: Name among ``TASKS``.
        texts: Options, each ``NAME=VALUE``.

    Raises:
        ValueError: If an option has no value, the task has none of that name, or what
            the task needs is not installed or its data are elsewhere.

    Example:
        >>> task_of("numerical", ["variant=sinh"]).variant
        'sinh'
    """
    values = {key: as_json(text) for key, text in pairs_of(texts).items()}
    try:
        return get_task(name, **values)
    except (ImportError, FileNotFoundError, TypeError) as error:
        known = "= or ".join([*inspect.signature(TASKS[name]).parameters, ""])
        raise ValueError(
            f"expected what {name!r} needs; got {values} ({error}); install it, or "
            f"set --option {known}"
        ) from error


def problem_of(
    given: Mapping[str, Any], needs: Sequence[str] = ("prior", "actions")
) -> tuple[Any, Any, Any, list[Effect]]:
    """Return simulator, prior, actions and effects that options give.

    A prior or actions that are not declared are None.

    Args:
        given: Values of the options ``PROBLEM``, ``EFFECTS``, "names" and "units" by
            their names, as far as there are any; and as "folder" where the names of
            programs begin, see :func:`load_object`.
        needs: Parts without which nothing can be done.

    Raises:
        ValueError: If too much or too little is given, or it is not what it has to be.
    """
    simulator, task, folder = map(given.get, ("simulator", "task", "folder"))
    if (task is None) == (simulator is None):
        raise ValueError(
            "expected --simulator or --task; got both or neither; name one, as in "
            "--simulator my_robot.py:fn"
        )
    model: Any
    bounded, found, own = prior_of(given), None, []
    if task is None:
        model = load_object(str(simulator), folder)
    else:
        whole: Any = task_of(task, given.get("option", ()))
        if bounded is not None:
            raise ValueError("expected no prior beside --task; got both; drop one")
        model, bounded, found = whole.simulator, whole.prior, whole.actions
        own = getattr(whole, "effects", list)()
    actions, names, units = map(given.get, ("actions", "names", "units"))
    space: Any = actions_of(actions, folder) if actions else found
    if bounded is None and "prior" in needs:
        raise ValueError(
            "expected --theta-low and --theta-high, or --prior; got none; give bounds "
            "as in --theta-low=0,-1 --theta-high=1,1"
        )
    if space is None and "actions" in needs:
        raise ValueError("expected --actions; got none; write, say, --actions 0:5:11")
    if space is not None and (names or units):
        labels = names.split(",") if names else space.names
        space._label(labels, units.split(",") if units else space.units)
    own += effects_of(given.get("effects", ()), folder)
    return with_noise(model, given.get("noise")), bounded, space, own


def with_noise(simulator: Any, sd: Sequence[float] | None) -> Any:
    """Return a simulator with the Gaussian noise that --noise gives; None for none.

    Raises:
        ValueError: If it is no function, or the noise is not positive.
    """
    if not callable(simulator):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(simulator).__name__}; "
            "name what takes (theta, action)"
        )
    if sd is None:
        return simulator
    require(min(sd) > 0, "--noise > 0", sd, "give the standard deviation of x")
    noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    if not isinstance(simulator, SimulatorModel):
        return SimulatorModel(simulator, noise=noise)
    noisy = copy.copy(simulator)
    noisy.noise = noise
    return noisy


def prior_of(given: Mapping[str, Any]) -> Distribution | None:
    """Return the prior that --prior, or --theta-low and --theta-high, name."""
    prior, low, high = map(given.get, ("prior", "theta_low", "theta_high"))
    if prior is not None:
        return load_object(prior, given.get("folder"), kind=Distribution)
    if low is None and high is None:
        return None
    if low is None or high is None or len(low) != len(high):
        raise ValueError(
            f"expected --theta-low and --theta-high; got {low} and {high}; give one of "
            "each a parameter"
        )
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"expected low below high; got {low} and {high}; swap them")
    return BoxUniform(torch.tensor(low), torch.tensor(high))


def actions_of(specs: Sequence[str], folder: str | None = None) -> ActionSpace:
    """Return the action space that --actions names."""
    if names_object(specs):
        return load_object(specs[0], folder, kind=ActionSpace)
    entries = [_entry(spec) for spec in specs]
    values = [entry for entry in entries if isinstance(entry, list)]
    if len(values) == len(entries):
        _require_few(math.prod(map(len, values)))
        return DiscreteActions(torch.cartesian_prod(*map(torch.tensor, values)))
    if not values:
        low, high = zip(*entries, strict=True)
        return BoxActions([*low], [*high])
    parts: list[ActionSpace] = []
    for k, entry in enumerate(entries):
        names = [f"action_{k}"]
        if isinstance(entry, list):
            parts.append(DiscreteActions(entry, names=names))
        else:
            parts.append(BoxActions([entry[0]], [entry[1]], names=names))
    return MixedActions(*parts)


def _entry(spec: str) -> tuple[float, float] | list[float]:
    """Return the limits that LOW:HIGH writes, or the values that anything else does."""
    parts = spec.split(":")
    if len(parts) == 1:
        return [number_of(part) for part in spec.split(",")]
    count = int(parts[2]) if len(parts) == 3 and parts[2].isdecimal() else 0
    if len(parts) > 2 and count < 1:
        raise ValueError(
            f"expected LOW:HIGH:COUNT or A,B,...; got {spec!r}; write, say, 0:5:11"
        )
    low, high = map(number_of, parts[:2])
    _require_few(count)
    return torch.linspace(low, high, count).tolist() if count else (low, high)


def _require_few(count: int) -> None:
    advice = "write LOW:HIGH for any number between, or a smaller COUNT"
    require(count <= MOST_ACTIONS, f"at most {MOST_ACTIONS} actions", count, advice)


def effects_of(names: Sequence[str], folder: str | None = None) -> list[Effect]:
    """Return effects, each name that of a list or of a function that returns one."""
    effects: list[Effect] = []
    for name in names:
        listed: Any = load_object(name, folder)
        listed = listed() if callable(listed) else listed
        listed = [*listed] if isinstance(listed, Iterable) else [listed]
        if not all(isinstance(effect, Effect) for effect in listed):
            raise ValueError(
                f"expected a list of Effect under {name}; got {listed!r:.80}; declare "
                "sbi_active.criticism.Effect"
            )
        effects += listed
    return effects


def with_generic(
    own: Sequence[Effect], simulator: Any, space: Any, prior: Distribution
) -> list[Effect]:
    """Return effects and the generic ones, each name once.

    Args:
        own: Effects that are declared.
        simulator: Simulator as it was before any effect was adopted.
        space: Actions, or trials with inputs.
        prior: Prior of the simulator's parameters.
    """
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    found: dict[str, Effect] = {}
    for effect in [*own, *generic_effects(simulator, space, prior=prior)]:
        found.setdefault(effect.name, effect)
    return [*found.values()]


def library_of(campaign: Campaign, effects: Sequence[str]) -> list[Effect]:
    """Return the effects to compare a campaign's simulator with.

    Args:
        campaign: Campaign whose own effects follow, and then the usual ones.
        effects: Names of further effects, which come first.
    """
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    own = [*effects_of(effects), *campaign.effects]
    return with_generic(own, base, campaign.actions, campaign.first_prior)


def open_campaign(
    folder: Path,
    *,
    simulates: bool,
    simulator: str | None = None,
    trust: bool = False,
    simulator_changed: bool = False,
    repair: bool = False,
) -> Campaign:
    """Return the campaign of a folder.

    Args:
        folder: Folder of the campaign.
        simulates: Whether its simulator is needed; else nothing of the folder is
            imported.
        simulator: Place of the simulator; None if the folder says it.
        trust: Whether to import what the folder names.
        simulator_changed: Whether to take another simulator than before.
        repair: Whether to give up what is damaged.

    Raises:
        ValueError: If there is no campaign, or its simulator is not known, or
            only the folder says so.
    """
    reader = Campaign.load(folder, repair=repair)
    if not simulates:
        return reader
    declared = read_declared(folder)
    if simulator is not None:  # whose place begins here
        declared |= {"simulator": absolute(simulator), "task": None}
    require_trust(folder, declared, own=simulator, trusts=trust)
    model, prior, actions, own = problem_of(declared, needs=())
    if reader.state.version.effects:
        own = with_generic(own, model, reader.actions, reader.first_prior)
    return Campaign.load(
        folder,
        simulator=model,
        prior=prior,
        actions=actions,
        effects=own,
        simulator_changed=simulator_changed,
    )
