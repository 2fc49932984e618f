"""Problems that options name: simulators, priors, action spaces, tasks, effects.

A campaign's folder may come from an untrusted source, so nothing in it says what is
imported. What was named by ``init``, ``run`` or ``--simulator`` is remembered for the
folder, outside of it.
"""

from __future__ import annotations

import copy
import hashlib
import importlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from operator import lt
from pathlib import Path
from typing import Any

import torch
from attrs import evolve
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Distribution

from sbi_active import BoxActions, Campaign, CampaignOptions, DiscreteActions
from sbi_active.actions import ActionSpace
from sbi_active.campaign.storage.codec import NotStorableError
from sbi_active.cli.declare import located, misuse, number_of, pairs_of
from sbi_active.criticism import Effect, generic_effects
from sbi_active.expected import did_you_mean, require
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks import Task, get_task  # pyright: ignore


def load_module(place: str, here: str | None = None) -> tuple[Any, str]:
    """Import what ``module:name`` or ``path/file.py:name`` names.

    Args:
        place: Place of an object.
        here: Folder where a module is looked for first; None is the current one.

    Returns:
        The module, and the name.

    Raises:
        ValueError: If there is no such module or name, or it cannot be imported.
    """
    module, _, name = place.partition(":")
    expected = "MODULE:NAME or file.py:NAME, such as my_robot.py:simulator"
    require(bool(name), expected, repr(place), "add its name behind a colon")
    file = Path(module).resolve() if module.endswith(".py") else None
    require(file is None or file.is_file(), "a file", f"none at {file}", "check it")
    here = here or os.getcwd()  # before what is installed
    module, folder = (file.stem, str(file.parent)) if file else (module, here)
    sys.path[:] = [folder, *(p for p in sys.path if p != folder)]
    try:
        loaded = importlib.import_module(module)
        origin = Path(getattr(loaded, "__file__", None) or "built in").resolve()
        alone = "a file whose name no other module has"
        require(file in (None, origin), alone, f"one called as {origin}", "rename it")
    except (Exception, SystemExit) as error:
        got = f"{located(error)} from {place}"
        raise ValueError(f"expected {expected}; got {got}; correct it") from error
    advice = did_you_mean(name, vars(loaded), "correct it")
    require(hasattr(loaded, name), f"a name in {module}", repr(name), advice)
    return loaded, name


def campaign_options(texts: Sequence[str]) -> CampaignOptions:
    """Return the options of a campaign, each text ``NAME=VALUE``, or a field of one."""
    options = CampaignOptions()
    for name, value in pairs_of(texts).items():
        with misuse("a setting of a campaign"):
            options = _changed(options, name.split("."), value)
    return options


def _changed(settings: Any, names: Sequence[str], value: Any) -> Any:
    name, *rest = names
    value = _changed(getattr(settings, name), rest, value) if rest else value
    return evolve(settings, **{name: value})


def task_of(name: str, texts: Sequence[str]) -> Task:
    """Return a task with the options of a command line.

    Args:
        name: Name of the task.
        texts: Options, each ``NAME=VALUE``.

    Raises:
        ValueError: If the task has no such option, or what it needs is not installed
            or its data are elsewhere.

    Example:
        >>> task_of("numerical", ["variant=sinh"]).variant
        'sinh'
    """
    with misuse(f"what {name!r} needs"):
        return get_task(name, **pairs_of(texts))


def problem_of(
    given: Mapping[str, Any], needs: Sequence[str] = ("prior", "actions")
) -> tuple[Any, Any, Any, list[Effect]]:
    """Return simulator, prior, actions and effects that options give.

    What they leave out is taken from the simulator's module. A prior or actions that
    are not declared are None.

    Args:
        given: Values of the options ``SIMULATOR``, ``SPACE``, "names" and "units" by
            their names, as far as there are any, and the folder of a module.
        needs: Parts without which nothing can be done.

    Raises:
        ValueError: If too little is given, or it is not what it has to be.
    """
    if given.get("task"):
        found = task_of(given["task"], given["option"])
        declared = getattr(found, "effects", list)
        return found.simulator, found.prior, found.actions, declared()
    advice = "name it, as in --simulator my_robot.py:fn"
    require(bool(given.get("simulator")), "--simulator", "none", advice)
    module, name = load_module(given["simulator"], given.get("folder"))
    model = with_noise(getattr(module, name), given.get("noise"))
    prior = _prior_of(given) or getattr(module, "prior", None)
    specs, names, units = map(given.get, ("actions", "names", "units"))
    space: Any = actions_of(specs) if specs else getattr(module, "actions", None)
    effects = [*getattr(module, "effects", ())]
    for part, value, kind, said in (
        ("prior", prior, Distribution, "--theta-low and --theta-high, or a prior"),
        ("actions", space, ActionSpace, "--actions, or actions"),
    ):
        is_right = isinstance(value, kind) or value is None and part not in needs
        got = f"{type(value).__name__} in {module.__name__}"
        require(is_right, f"{said} of class {kind.__name__}", got, "declare one")
    if space is not None and (names or units):
        labels = names.split(",") if names else space.names
        space._label(labels, units.split(",") if units else space.units)
    return model, prior, space, effects


def with_noise(simulator: Any, sd: Sequence[float] | None) -> Any:
    """Return a simulator with the Gaussian noise that --noise gives; None for none.

    Raises:
        ValueError: If it is no function, or the noise is not positive.
    """
    got, advice = type(simulator).__name__, "name what takes (theta, action)"
    require(callable(simulator), "a function or SimulatorModel", got, advice)
    if sd is None:
        return simulator
    require(min(sd) > 0, "--noise > 0", sd, "give the standard deviation of x")
    is_model = isinstance(simulator, SimulatorModel)
    noisy = copy.copy(simulator) if is_model else SimulatorModel(simulator)
    noisy.noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    return noisy


def _prior_of(given: Mapping[str, Any]) -> Distribution | None:
    low, high = given.get("theta_low") or [], given.get("theta_high") or []
    is_box = len(low) == len(high) and all(map(lt, low, high))
    expected = "--theta-low below --theta-high, one of each a parameter"
    require(is_box, expected, f"{low} and {high}", "give both")
    return BoxUniform(torch.tensor(low), torch.tensor(high)) if low else None


def actions_of(specs: Sequence[str]) -> ActionSpace:
    """Return the action space that --actions names."""
    if all(spec.count(":") == 1 for spec in specs):
        low, high = zip(*(map(number_of, s.split(":")) for s in specs), strict=True)
        return BoxActions([*low], [*high])
    return DiscreteActions(torch.cartesian_prod(*map(_values_of, specs)))


def _values_of(spec: str, most: int = 100_000) -> Tensor:
    """Return the values of an entry; ``most`` are more than any design tells apart."""
    low, *rest = spec.split(":")
    if not rest:
        return torch.tensor([*map(number_of, spec.split(","))])
    count = int(rest[1]) if len(rest) == 2 and rest[1].isdecimal() else 0
    expected = f"LOW:HIGH:COUNT of at most {most} actions, or A,B,..."
    advice = "write, say, 0:5:11; declare a mix of limits and values as actions"
    require(0 < count <= most, expected, repr(spec), advice)
    return torch.linspace(number_of(low), number_of(rest[0]), count)


def with_generic(own: Any, simulator: Any, space: Any, prior: Any) -> list[Effect]:
    """Return effects and the generic ones, each name once.

    Args:
        own: Effects that are declared.
        simulator: Simulator as it was before any effect was adopted.
        space: Actions, or trials with inputs.
        prior: Prior of the simulator's parameters.
    """
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    named = {effect.name for effect in own}
    generic = generic_effects(simulator, space, prior=prior)
    return [*own, *(effect for effect in generic if effect.name not in named)]


def library_of(campaign: Campaign) -> list[Effect]:
    """Return the effects to compare a campaign's simulator with."""
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    return with_generic(campaign.effects, base, campaign.actions, campaign.first_prior)


def open_campaign(
    folder: Path, simulator: str | None, noise: Any, simulates: bool = True, **how: Any
) -> Campaign:
    """Return the campaign of a folder.

    Args:
        folder: Folder of the campaign.
        simulator: Place of the simulator; None is the one that was named before.
        noise: Standard deviation of x; None is what was given before.
        simulates: Whether its simulator is needed, whose module is imported then, and
            else where the campaign has a prior or actions that only this can make.
        **how: Further arguments of :meth:`.Campaign.load`.

    Raises:
        ValueError: If there is no campaign, or its simulator is not known.
    """
    reader: Campaign | None = None
    with suppress(NotStorableError):  # as of a prior that only a program can make
        reader = Campaign.load(folder)
        if not simulates:
            return reader
    known = {"simulator": simulator, "noise": noise}
    if not simulator:  # as whoever made the campaign here named it
        with suppress(OSError, ValueError):
            known = json.loads(_path_of(folder).read_text())
    model, prior, actions, effects = problem_of(known, needs=())
    own: Any = {} if reader else {"prior": prior, "actions": actions}
    reader = reader or Campaign.load(folder, **own)
    if reader.state.version.effects:
        effects = with_generic(effects, model, reader.actions, reader.first_prior)
    campaign = Campaign.load(folder, simulator=model, effects=effects, **own, **how)
    remember(folder, **known)
    return campaign


def remember(folder: Path, /, **options: Any) -> None:
    """Write down which program somebody here named for a campaign."""
    place, colon, name = (options.get("simulator") or "").partition(":")
    if place.endswith(".py"):
        options["simulator"] = f"{Path(place).resolve()}{colon}{name}"
    path = _path_of(folder)
    with suppress(OSError):  # as in a home that is read only: --simulator each time
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"folder": os.getcwd(), **options}))


def _path_of(folder: Path) -> Path:
    home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()
    return Path(home, "sbi-active", f"{name}.json")
