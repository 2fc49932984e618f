"""What a campaign is, in a file that a person can read and nothing changes."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.damage import DamagedCampaignError
from sbi_active.campaign.storage.described import (
    describe_actions,
    describe_options,
    describe_prior,
)
from sbi_active.campaign.storage.drawn import draws_of
from sbi_active.simulation.bank.files import write_file
from sbi_active.simulation.bank.fingerprint import differences, fingerprint

MANIFEST, COPY = "campaign.json", "campaign.json.copy"
FORMAT, SCHEMA = "sbi-active campaign", 1
PACKAGES = ("sbi-active", "sbi", "torch", "numpy")


def new_manifest(
    state: CampaignState,
    *,
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: ActionSpace,
    x_shape: Sequence[int],
    effects: Sequence[str],
    has_cost: bool,
    has_constraint: bool,
) -> dict[str, Any]:
    """Return the description of a new campaign.

    Args:
        state: Of the campaign.
        simulator: As given.
        prior: As given.
        actions: As given.
        x_shape: Of an outcome.
        effects: Names of those that the simulator may lack.
        has_cost: Whether actions have a cost, which the reader must give again.
        has_constraint: Likewise.
    """
    names = getattr(simulator, "parameter_names", None)
    channels = getattr(simulator, "channel_names", None)
    described = {"prior": describe_prior(prior), "actions": describe_actions(actions)}
    return {
        "format": FORMAT,
        "schema": SCHEMA,
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "packages": _packages(),
        "method": state.method,
        "seed": state.seed,
        "num_earlier": state.num_earlier,
        "parameter_names": None if names is None else [*names],
        "channel_names": None if channels is None else [*channels],
        "x_shape": [*x_shape],
        "prior": described["prior"],
        "prior_text": repr(prior),
        "actions": described["actions"],
        "actions_text": repr(actions),
        "options": describe_options(state.options),
        "options_text": repr(state.options),
        "drawn": {
            what: draws_of(thing, seed=state.seed)
            for what, thing in (("prior", prior), ("actions", actions))
            if described[what] is None
        },
        "effects": [*effects],
        "has_cost": has_cost,
        "has_constraint": has_constraint,
        "simulator": fingerprint(simulator),
    }


def has_manifest(folder: Path) -> bool:
    """Return whether a folder holds a campaign."""
    return (folder / MANIFEST).exists() or (folder / COPY).exists()


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest and its copy.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted(path.name for path in folder.iterdir())
    except OSError as error:
        raise type(error)(
            error.errno,
            f"expected a folder that can be made for a campaign; got "
            f"{error.strerror!r}; choose a place that can be written",
            str(folder),
        ) from error
    if has_manifest(folder):
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with a "
            "campaign; go on with it by Campaign.load(directory, simulator=...), or "
            "choose another folder"
        )
    other = [name for name in found if not name.startswith(".")]
    if other:
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with "
            f"{other[0]!r}; choose another folder"
        )
    text = json.dumps({**manifest, "sha256": _digest(manifest)}, indent=2) + "\n"
    for name in (COPY, MANIFEST):
        write_file(folder / name, text.encode())


def read_manifest(folder: Path, *, repair: bool = False) -> dict[str, Any]:
    """Return a manifest.

    Args:
        folder: Of the campaign.
        repair: Take the copy where the manifest is damaged, and write it again.

    Raises:
        ValueError: If there is none, or one of another schema.
        DamagedCampaignError: If it does not hold what was written.
    """
    path = folder / MANIFEST
    if not has_manifest(folder):
        raise ValueError(
            f"expected a folder with a campaign; got {folder} without {MANIFEST}; make "
            "one by Campaign(..., directory=...)"
        )
    manifest = _read(path)
    if manifest is None and repair and (manifest := _read(folder / COPY)):
        write_file(path, (folder / COPY).read_bytes())
    if manifest is None:
        raise DamagedCampaignError(
            path, "a manifest with another checksum, the log of the trials untouched"
        )
    if manifest.get("format") != FORMAT or manifest.get("schema") != SCHEMA:
        raise ValueError(
            f"expected a campaign of schema {SCHEMA}; got "
            f"{manifest.get('format')!r} of schema {manifest.get('schema')} in {path}; "
            "use the release of sbi-active that wrote it: "
            f"{manifest.get('packages', {}).get('sbi-active', 'unknown')}"
        )
    return manifest


def require_same_simulator(
    manifest: Mapping[str, Any], simulator: Callable[..., Any]
) -> None:
    """Raise where a simulator is not the one that the campaign was made with.

    Raises:
        ValueError: It says where they differ.
    """
    lines = differences(manifest["simulator"], fingerprint(simulator))
    if lines:
        raise ValueError(
            "expected the simulator of the campaign; got another: "
            f"{'; '.join(lines)}; pass the one it was made with, or "
            "simulator_changed=True to compute everything again with this one"
        )


def _read(path: Path) -> dict[str, Any] | None:
    try:
        manifest = json.loads(path.read_bytes())
        digest = manifest.pop("sha256")
    except (OSError, ValueError, RecursionError, KeyError, AttributeError, TypeError):
        return None
    return manifest if digest == _digest(manifest) else None


def _digest(manifest: Mapping[str, Any]) -> str:
    text = json.dumps(manifest, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _packages() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
