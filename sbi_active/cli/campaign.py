"""Commands on a campaign that compute, and the campaign of a folder for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.campaign.options import GROUPS
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.cli.declared import (
    Declared,
    declare,
    read_declared,
    write_declared,
)
from sbi_active.cli.given import (
    effects_of,
    load_object,
    make_task,
    problem_of,
    simulator_of,
    with_generic,
)
from sbi_active.cli.output import Answer, say
from sbi_active.cli.trials import status, sum_up_campaign
from sbi_active.criticism import Effect
from sbi_active.renamed import grouped
from sbi_active.simulation.bank.store import Store

SIZES = ("num_simulations", "num_samples", "num_workers", "time_limit")


def init(
    folder: Path,
    *,
    config: Path | None,
    effects: str | None,
    method: str,
    seed: int,
    names: str | None,
    units: str | None,
    **options: Any,
) -> None:
    """Make a campaign in a new folder."""
    sizes = {name: options.pop(name) for name in SIZES}
    sizes = {name: size for name, size in sizes.items() if size is not None}
    declared = declare(effects=effects, **options)
    simulator, prior, space, _ = problem_of(**options)
    _label(space, "names", names)
    _label(space, "units", units)
    with Campaign(
        simulator,
        prior,
        space,
        method=method,
        effects=effects_of(declared["effects"]),
        seed=seed,
        options=CampaignOptions(**grouped(sizes, GROUPS)),
        directory=folder,
    ) as campaign:
        write_declared(folder, declared)
        sum_up_campaign(campaign)
        print(f"{folder}: a campaign of {campaign.actions}")
    print(f"next: sbi-active ask {folder}")


def _label(actions: Any, what: str, text: str | None) -> None:
    """Give the entries of actions names or units, as --names and --units say."""
    if text is None:
        return
    labels = text.split(",")
    if len(labels) != actions.action_dim:
        raise ValueError(
            f"expected --{what} of {actions.action_dim} entries; got {text!r}; "
            "separate them by commas, one an entry of the action"
        )
    setattr(actions, what, labels)


def criticize(
    campaign: Campaign, *, effects: str | None, out: Path | None = None
) -> Answer:
    """Return the report of a comparison of the simulator with the trials."""
    if out is not None:  # else all is computed before this fails
        out.mkdir(parents=True, exist_ok=True)
    report = campaign.criticize(library_of(campaign, effects_of([effects])))
    text = [str(report)]
    if out is not None:
        text.append(f"saved: {report.save(out)}")
    if report.tracing.chosen:
        named = "" if effects is None else f" --effects {effects}"
        text.append(f"to go on with it: sbi-active adopt {campaign.directory}{named}")
    return Answer(report.to_dict(), "\n\n".join(text))


def adopt(campaign: Campaign, *, effects: str | None) -> Answer:
    """Go on with the simulator that the verdict names."""
    report = campaign.criticize(
        library_of(campaign, effects_of([effects])), evaluate=False
    )
    campaign.adopt(report)
    if effects is not None:
        _declare_effects(Path(str(campaign.directory)), effects)
    say(f"adopted: {report.verdict}")
    return status(campaign)


def _declare_effects(folder: Path, name: str) -> None:
    """Let the commands to come find effects that the campaign was made without."""
    declared = read_declared(folder)
    module, colon, attribute = name.partition(":")
    if module.endswith(".py"):
        name = f"{Path(module).resolve()}{colon}{attribute}"
    effects = [*declared["effects"], name]
    write_declared(folder, {**declared, "effects": [*dict.fromkeys(effects)]})


def report(campaign: Campaign, *, out: Path | None) -> Answer:
    """Write one page that shows the campaign."""
    from sbi_active.campaign.display.page import write_page

    path = out or Path(str(campaign.directory), "report.html")
    return _saved(write_page(campaign, path))


def export(campaign: Campaign, *, netcdf: Path, seed: int) -> Answer:
    """Write the belief and the trials as ArviZ reads them."""
    from sbi_active.export import to_inference_data

    if campaign.simulator is None:
        say(
            "note: without predictions and likelihoods, for which the simulator runs: "
            "add --simulator, or --trust"
        )
    data = to_inference_data(campaign, seed=seed)
    try:
        data.to_netcdf(str(netcdf))
    except (ImportError, ValueError) as error:
        raise ValueError(
            f"expected a library that writes netCDF; got none ({error}); install one: "
            "pip install h5netcdf"
        ) from error
    return _saved(netcdf)


def _saved(path: object) -> Answer:
    return Answer({"saved": str(path)}, f"saved: {path}")


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
            imported without --trust.
        simulator: Place of the simulator; None if the folder says it.
        trust: Whether to import what the folder names.
        simulator_changed: Whether to take another simulator than before.
        repair: Whether to give up what is damaged.

    Raises:
        ValueError: If there is no campaign, or its simulator is not known, or
            only the folder says so.
    """
    declared = Declared(folder, trusts=trust)
    given = {}
    if simulates or trust:
        own = read_manifest(Store(folder, "campaign"))["own"]
        lacking = [what for what in ("prior", "actions") if what in own]
        given = {what: _object_of(declared, what) for what in lacking}
    reader = Campaign.load(folder, repair=repair, **given)
    if not simulates:
        return reader
    model = _simulator_of(declared, simulator)
    effects = effects_of(declared.names("effects"), declared.place)
    if reader.state.version.effects:
        effects = _with_usual(effects, model, reader)
    changed = {"simulator_changed": simulator_changed}
    return Campaign.load(folder, simulator=model, effects=effects, **changed, **given)


def _object_of(declared: Declared, what: str) -> Any:
    """Return an object of the task or the program that a folder declares."""
    if declared.task is not None:
        return getattr(make_task(declared.task, declared.options), what)
    names = declared.names(what)
    return load_object(names[0], declared.place) if names else None


def _simulator_of(declared: Declared, name: str | None) -> Any:
    if name is not None:
        return simulator_of(name, declared.noise)
    if declared.task is not None:
        return _object_of(declared, "simulator")
    names = declared.names("simulator")
    if not names:
        raise ValueError(
            "expected --simulator, since the campaign was made by a program; got none; "
            "name it, as in --simulator my_robot.py:fn"
        )
    return simulator_of(names[0], declared.noise, declared.place)


def library_of(campaign: Campaign, own: Sequence[Effect] = ()) -> list[Effect]:
    """Return the effects to compare, once each.

    Args:
        campaign: Campaign whose own effects follow, and then the usual ones.
        own: Effects that come first.
    """
    taken = {effect.name for effect in own}
    known = [effect for effect in campaign.effects if effect.name not in taken]
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    return _with_usual([*own, *known], base, campaign)


def _with_usual(own: list[Effect], simulator: Any, reader: Campaign) -> list[Effect]:
    return with_generic(own, simulator, reader.actions, reader.first_prior)
