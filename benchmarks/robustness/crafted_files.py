"""Attacks on a campaign's files: entries, bytes, lengths and links of somebody else."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import torch

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.campaign_problem import campaign, tell
from sbi_active import Campaign
from sbi_active.campaign.storage import DamagedCampaignError
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.campaign.storage.damage import LogChangedError
from sbi_active.campaign.storage.log import _opened, _sealed
from sbi_active.campaign.storage.manifest import COPY, MANIFEST, _digest

ATTACKS = Attacks()
FOLDER = Path("camp")
LOG = "trials.jsonl"
SPOILS = (None, [], {}, "", -1, 1e300, True, 10**9, "\ud800", [[]], [None] * 3)


def made() -> list[list[float]]:
    """Write a campaign of three trials and return what was told."""
    with tell(campaign(directory=str(FOLDER))) as c:
        c.update()
        return facts(c)


def facts(c: Campaign) -> list[list[float]]:
    """Return what was told: actions and outcomes."""
    return [
        [*t.action.tolist(), *(t.x.tolist() if t.x is not None else [])]
        for t in c.history
    ]


def same_or_refused(whole: list[list[float]]) -> None:
    """Require the same trials, or an error that says what is wrong."""
    warnings.simplefilter("ignore")
    try:
        found = Campaign.load(FOLDER)
        shown = found.history, found.health, str(found.belief)
    except (DamagedCampaignError, LogChangedError):
        return
    except ValueError as error:
        assert str(error).startswith("expected"), error
        return
    assert len(shown) == 3
    assert facts(found) == whole, (facts(found), whole)


@ATTACKS.add(
    "an entry of the manifest",
    cases=[(key, k) for key in range(12) for k in range(0, len(SPOILS), 3)],
)
def manifest(case: tuple[int, int]) -> None:
    index, k = case
    whole = made()
    entries = json.loads((FOLDER / MANIFEST).read_text())
    keys = sorted(set(entries) - {"sha256"})
    spoiled = {**entries, keys[index % len(keys)]: SPOILS[k]}
    spoiled.pop("sha256", None)
    spoiled["sha256"] = _digest(spoiled)
    for name in (MANIFEST, COPY):
        (FOLDER / name).write_text(json.dumps(spoiled))
    same_or_refused(whole)


@ATTACKS.add(
    "the numbers of a trial in the log",
    cases=[
        (key, k)
        for key in ("x", "action", "status", "index")
        for k in range(len(SPOILS))
    ],
)
def entry(case: tuple[str, int]) -> None:
    key, k = case
    whole = made()
    path = FOLDER / LOG
    entries = [_opened(line) for line in path.read_bytes().splitlines()]
    last = entries[-1]
    assert last is not None
    owner = last["trial"] if key in last.get("trial", {}) else last
    owner[key] = SPOILS[k]
    path.write_bytes(b"".join(map(_sealed, filter(None, entries))))
    if key == "x" and SPOILS[k] is None:
        whole = [*whole[:-1], whole[-1][:1]]  # a trial without an outcome is one
    same_or_refused(whole)


@ATTACKS.add(
    "bytes of a file",
    cases=[
        (name, how)
        for name in ("trials.jsonl", "state.bin", MANIFEST, "belief")
        for how in ("flipped", "cut", "empty", "nuls", "twice", "removed", "text")
    ],
)
def spoiled_bytes(case: tuple[str, str]) -> None:
    name, how = case
    whole = made()
    path = next(FOLDER.glob(f"{name}*"))
    content = path.read_bytes()
    middle = len(content) // 2
    flipped = bytearray(content)
    flipped[middle] ^= 0x5A
    left = {
        "flipped": bytes(flipped),
        "cut": content[:middle],
        "empty": b"",
        "nuls": b"\0" * len(content),
        "twice": content + content,
        "text": b"hello\n",
    }
    path.unlink()
    if how != "removed":
        path.write_bytes(left[how])
    same_or_refused(whole)
    try:
        with Campaign.load(FOLDER, repair=True) as c:
            assert facts(c) == whole, facts(c)
            c.attach([1.0], 0.4)
        assert len(Campaign.load(FOLDER).history) == len(whole) + 1
    except DamagedCampaignError:  # it says so, but a belief is computed again
        assert name != "belief", how


@ATTACKS.add("a small file that fills memory", cases=(10**7, 10**8, 4 * 10**8))
def bomb(size: int) -> None:
    content = encode(torch.zeros(size // 4), known={})
    assert len(content) < size / 100
    try:
        decode(content, known={})
    except ValueError as error:
        assert str(error).startswith("expected")
    else:
        assert size <= 10**7


@ATTACKS.add("random bytes to the reader of states", cases=range(20))
def noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    content = bytearray(encode({"a": torch.ones(3), "b": [1, "x"]}, known={}))
    for _ in range(1 + seed % 5):
        content[int(rng.integers(len(content)))] = int(rng.integers(256))
    try:
        decode(bytes(content), known={})
    except ValueError as error:
        assert "expected" in str(error), error


@ATTACKS.add(
    "a link in a folder leads elsewhere",
    cases=("writer.json", "writer.lock", LOG, "trials.damaged", "state.bin", MANIFEST),
)
def link(name: str) -> None:
    made()
    mine = Path("mine.txt")
    mine.write_text("precious")
    (FOLDER / name).unlink(missing_ok=True)
    (FOLDER / name).symlink_to(mine.absolute())
    try:
        with Campaign.load(FOLDER, repair=True) as c:
            c.attach([1.0], 0.1)
            c.update()
    except (OSError, ValueError, DamagedCampaignError, LogChangedError):
        pass
    assert mine.read_text() == "precious"


@ATTACKS.add("files of another campaign", cases=("state.bin", LOG, MANIFEST, "belief"))
def mixed(name: str) -> None:
    with campaign(directory="other", seed=5) as other:
        for x in (0.1, 0.2):
            other.tell(x, action=[3.0])
        other.update()
    whole = made()
    theirs, ours = next(Path("other").glob(f"{name}*")), next(FOLDER.glob(f"{name}*"))
    shutil.copy(theirs, ours)
    same_or_refused(whole)
