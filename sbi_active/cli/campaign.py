"""``sbi-active init``, and what a campaign's folder is compared and shown with."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.declared import declare, read_declared, write_declared
from sbi_active.cli.folder import library_of
from sbi_active.cli.given import actions_of, effects_of, prior_of, simulator_of
from sbi_active.cli.trials import status, sum_up_campaign
from sbi_active.cli.words import Answer

SIZES = ("num_simulations", "num_samples", "num_workers", "time_limit")


def init(
    folder: Path,
    *,
    config: Path | None,
    simulator: str | None,
    noise: str | None,
    actions: Sequence[str],
    effects: str | None,
    method: str,
    seed: int,
    **options: Any,
) -> None:
    """Make a campaign in a new folder."""
    declared = declare(simulator, noise, options["prior"], actions, effects)
    sizes = {name: options[name] for name in SIZES if options[name] is not None}
    bounds = options["theta_low"], options["theta_high"]
    space = actions_of(actions)
    for what in ("names", "units"):
        _label(space, what, options[what])
    with Campaign(
        simulator_of(declared["simulator"], noise),
        prior_of(options["prior"], *bounds),
        space,
        method=method,
        effects=effects_of(declared["effects"]),
        seed=seed,
        options=CampaignOptions(**sizes),
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
) -> None:
    """Compare the campaign's simulator with its trials, and print the report."""
    own = [] if effects is None else [effects]
    report = campaign.criticize(library_of(campaign, effects_of(own)))
    print(report)
    if out is not None:
        print(f"\nsaved: {report.save(out)}")
    if report.tracing.chosen:
        named = "" if effects is None else f" --effects {effects}"
        print(f"\nto go on with it: sbi-active adopt {campaign.directory}{named}")


def adopt(campaign: Campaign, *, effects: str | None) -> Answer:
    """Go on with the simulator that the verdict names."""
    own = [] if effects is None else [effects]
    report = campaign.criticize(library_of(campaign, effects_of(own)), evaluate=False)
    campaign.adopt(report)
    if effects is not None:
        _declare_effects(Path(str(campaign.directory)), effects)
    print(f"adopted: {report.verdict}", file=sys.stderr)
    return status(campaign)


def _declare_effects(folder: Path, name: str) -> None:
    """Let the commands to come find effects that the campaign was made without."""
    declared = read_declared(folder)
    module, colon, attribute = name.partition(":")
    if module.endswith(".py"):
        name = f"{Path(module).resolve()}{colon}{attribute}"
    effects = [*(declared.get("effects") or ()), name]
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
        print(
            "sbi-active: note: without predictions and likelihoods, for which the "
            "simulator runs: add --simulator, or --trust",
            file=sys.stderr,
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
