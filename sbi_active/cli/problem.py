"""Objects that options name: simulators, priors, action spaces, tasks, effects."""

from __future__ import annotations

import copy
import importlib
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import lt
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, BoxActions, DiscreteActions, MixedActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.declare import FORMER, as_json, number_of, pairs_of
from sbi_active.cli.output import located
from sbi_active.cli.trusted import names_object, read_declared, require_trust
from sbi_active.criticism import Effect, generic_effects
from sbi_active.expected import require
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.simulation.bank.store import Store
from sbi_active.tasks import Task, get_task  # pyright: ignore

#: Actions of one space. A choice: each is stored in the campaign's folder and takes
#: part in each design; twice as many take twice the memory, and half are still more
#: than any design tells apart.
MOST_ACTIONS = 100_000


def load_object(name: str, kind: Any = object) -> Any:
    """Import what a user names.

    Args:
        name: ``module:attribute``, or ``path/file.py:attribute``.
        kind: Class that it has to be of.

    Raises:
        ValueError: If there is no such module or attribute, it cannot be imported, or
            it is of another class.
    """
    module, _, attribute = name.partition(":")
    file = Path(module).resolve() if module.endswith(".py") else None
    if file is not None:
        require(file.is_file(), "a file", f"none at {file}", "check the path")
        sys.path.insert(0, str(file.parent))
        module = file.stem
    elif (here := os.getcwd()) in sys.path:  # before what is installed
        sys.path.remove(here)
        sys.path.insert(0, here)
    try:
        loaded = importlib.import_module(module)
        origin = getattr(loaded, "__file__", None)
        is_own = file is None or origin is not None and Path(origin).resolve() == file
        found = getattr(loaded, attribute) if is_own else None
    except (Exception, SystemExit) as error:
        raise ValueError(
            "expected MODULE:NAME, such as my_robot:simulator, to be imported; got "
            f"{located(error)} from {name}; correct it"
        ) from error
    if not is_own:
        raise ValueError(
            f"expected a file whose name no other module has; got {module}.py, which "
            f"is also {origin or 'built in'}; rename the file"
        )
    if not isinstance(found, kind):
        raise ValueError(
            f"expected a {kind.__name__} under {name}; got {type(found).__name__}; "
            "name another object"
        )
    return found


def campaign_options(given: dict[str, Any]) -> CampaignOptions:
    """Return the options of a campaign that --set gives, which are taken from these."""
    former = {FORMER[name]: given.pop(name) for name in {*FORMER} & {*given}}
    texts = {name: text for name, text in former.items() if text is not None}
    options = CampaignOptions()
    for name, text in (texts | pairs_of(given.pop("set"))).items():
        try:
            options = _changed(options, name, as_json(text))
        except (TypeError, AttributeError) as error:
            raise ValueError(
                f"expected a setting of a campaign; got {name}={text} ({error}); "
                "correct it"
            ) from error
    return options


def _changed(settings: Any, name: str, value: Any) -> Any:
    """Return settings with a field of another value, or with a field of a field."""
    field, point, rest = name.partition(".")
    if point:
        value = _changed(getattr(settings, field), rest, value)
    return replace(settings, **{field: value})


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
        raise ValueError(
            f"expected what {name!r} needs; got {values} ({error}); install it, or "
            "correct --option"
        ) from error


def problem_of(
    given: Mapping[str, Any], needs: Sequence[str] = ("prior", "actions")
) -> tuple[Any, Any, Any, list[Effect]]:
    """Return simulator, prior, actions and effects that options give.

    A prior or actions that are not declared are None.

    Args:
        given: Values of the options ``PROBLEM``, ``EFFECTS``, "names" and "units" by
            their names, as far as there are any. They count before what a task has.
        needs: Parts without which nothing can be done.

    Raises:
        ValueError: If too much or too little is given, or it is not what it has to be.
    """
    simulator, task = given.get("simulator"), given.get("task")
    if (task is None) == (simulator is None):
        raise ValueError(
            "expected --simulator or --task; got both or neither; name one, as in "
            "--simulator my_robot.py:fn"
        )
    whole: Any = None if task is None else task_of(task, given.get("option", ()))
    model = load_object(str(simulator)) if whole is None else whole.simulator
    prior = prior_of(given) or getattr(whole, "prior", None)
    if prior is None and "prior" in needs:
        raise ValueError(
            "expected --theta-low and --theta-high, or --prior; got none; give bounds "
            "as in --theta-low=0,-1 --theta-high=1,1"
        )
    actions, names, units = map(given.get, ("actions", "names", "units"))
    space: Any = actions_of(actions) if actions else getattr(whole, "actions", None)
    if space is None and "actions" in needs:
        raise ValueError("expected --actions; got none; write, say, --actions 0:5:11")
    if space is not None and (names or units):
        labels = names.split(",") if names else space.names
        space._label(labels, units.split(",") if units else space.units)
    effects = [
        *getattr(whole, "effects", list)(),
        *effects_of(given.get("effects", ())),
    ]
    return with_noise(model, given.get("noise")), prior, space, effects


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
    is_model = isinstance(simulator, SimulatorModel)
    noisy = copy.copy(simulator) if is_model else SimulatorModel(simulator)
    noisy.noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    return noisy


def prior_of(given: Mapping[str, Any]) -> Distribution | None:
    """Return the prior that --prior, or --theta-low and --theta-high, name."""
    prior, low, high = map(given.get, ("prior", "theta_low", "theta_high"))
    if prior is not None:
        return load_object(prior, kind=Distribution)
    if low is None and high is None:
        return None
    expected = "--theta-low below --theta-high, one of each a parameter"
    low, high = low or [], high or []
    is_box = len(low) == len(high) and all(map(lt, low, high))
    require(is_box, expected, f"{low} and {high}", "give both")
    return BoxUniform(torch.tensor(low), torch.tensor(high))


def actions_of(specs: Sequence[str]) -> ActionSpace:
    """Return the action space that --actions names."""
    if len(specs) == 1 and names_object(specs[0]):
        return load_object(specs[0], kind=ActionSpace)
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
            parts.append(BoxActions(*entry, names=names))
    return MixedActions(*parts)


def _entry(spec: str) -> tuple[float, float] | list[float]:
    """Return the limits that LOW:HIGH writes, or the values that anything else does."""
    parts = spec.split(":")
    if len(parts) == 1:
        return [number_of(part) for part in spec.split(",")]
    low, high = map(number_of, parts[:2])
    if len(parts) == 2:
        return low, high
    count = int(parts[2]) if len(parts) == 3 and parts[2].isdecimal() else 0
    require(count > 0, "LOW:HIGH:COUNT or A,B,...", repr(spec), "write, say, 0:5:11")
    _require_few(count)
    return torch.linspace(low, high, count).tolist()


def _require_few(count: int) -> None:
    advice = "write LOW:HIGH for any number between, or a smaller COUNT"
    require(count <= MOST_ACTIONS, f"at most {MOST_ACTIONS} actions", count, advice)


def effects_of(names: Sequence[str]) -> list[Effect]:
    """Return effects, each name that of a list or of a function that returns one."""
    effects: list[Effect] = []
    for name in names:
        listed: Any = load_object(name)
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
    generic = generic_effects(simulator, space, prior=prior)
    found: dict[str, Effect] = {}
    for effect in [*own, *generic]:
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
    simulator: str | None = None,
    trust: bool = False,
    simulator_changed: bool = False,
) -> Campaign:
    """Return the campaign of a folder, with its simulator.

    Args:
        folder: Folder of the campaign.
        simulator: Place of the simulator; None if the folder says it.
        trust: Whether to import what the folder names.
        simulator_changed: Whether to take another simulator than before.

    Raises:
        ValueError: If there is no campaign, or its simulator is not known, or
            only the folder says so.
    """
    Store(folder, "campaign")  # where there is none, this is said first
    declared = read_declared(folder)
    if simulator is not None:
        declared |= {"simulator": None, "task": None, "option": []}
    require_trust(folder, declared, trusts=trust)
    sys.path += filter(None, [declared.get("folder")])  # where modules were found
    own = {} if simulator is None else {"simulator": simulator}
    model, prior, actions, effects = problem_of({**declared, **own}, needs=())
    reader = Campaign.load(folder, prior=prior, actions=actions)
    if reader.state.version.effects:
        effects = with_generic(effects, model, reader.actions, reader.first_prior)
    return Campaign.load(
        folder,
        simulator=model,
        prior=prior,
        actions=actions,
        effects=effects,
        simulator_changed=simulator_changed,
    )
