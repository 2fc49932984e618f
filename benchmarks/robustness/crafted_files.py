"""Attacks on a campaign's files: entries, bytes, lengths and links of somebody else."""

from __future__ import annotations

import json
import sqlite3
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.bank import crafted_record
from benchmarks.robustness.bank_files import execute
from benchmarks.robustness.campaign_problem import campaign, tell
from sbi_active import Campaign
from sbi_active.campaign.storage import DamagedCampaignError
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.campaign.storage.damage import LogChangedError
from sbi_active.simulation.bank.store import Store

ATTACKS = Attacks()
FOLDER = Path("camp")
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


def record(table: str, kind: str, number: int) -> dict[str, Any]:
    """Return what a record of JSON holds."""
    content = Store(FOLDER, "campaign").get(table, kind, number)
    assert content is not None
    return json.loads(content)


@ATTACKS.add(
    "an entry of the manifest",
    cases=[(key, k) for key in range(12) for k in range(0, len(SPOILS), 3)],
)
def manifest(case: tuple[int, int]) -> None:
    index, k = case
    whole = made()
    entries = record("objects", "campaign", 0)
    keys = sorted(entries)
    spoiled = {**entries, keys[index % len(keys)]: SPOILS[k]}
    for table in ("objects", "events"):
        crafted_record(FOLDER, table, "campaign", 0, spoiled)
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
    number = len(Campaign.load(FOLDER).events)
    last = record("events", "log", number)
    owner = last["trial"] if key in last.get("trial", {}) else last
    owner[key] = SPOILS[k]
    crafted_record(FOLDER, "events", "log", number, last)
    same_or_refused(whole)


RECORDS: dict[str, str] = {
    **dict.fromkeys(("state", "belief", "campaign"), "objects"),
    "log": "events",
}


@ATTACKS.add(
    "bytes of a record",
    cases=[
        (name, how)
        for name in RECORDS
        for how in ("flipped", "cut", "empty", "nuls", "twice", "removed", "text")
    ],
)
def spoiled_bytes(case: tuple[str, str]) -> None:
    name, how = case
    whole = made()
    table, number = RECORDS[name], 2 if name == "log" else 0
    content = Store(FOLDER, "campaign").get(table, name, number) or b""
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
    where = "WHERE kind = ? AND number = ?"
    if how == "removed":
        execute(FOLDER, f"DELETE FROM {table} {where}", name, number)
    else:
        change = f"UPDATE {table} SET content = ? {where}"
        execute(FOLDER, change, left[how], name, number)
    same_or_refused(whole)
    repaired(whole)


@ATTACKS.add(
    "bytes of the file",
    cases=[
        (how, place)
        for how in ("flipped", "nuls", "cut")
        for place in (0.02, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
    ],
)
def spoiled_file(case: tuple[str, float]) -> None:
    how, share = case
    whole = made()
    path = FOLDER / "store.db"
    content = bytearray(path.read_bytes())
    place = int(share * len(content))
    if how == "flipped":
        content[place] ^= 0x5A
    elif how == "nuls":
        page = place // 4096 * 4096
        content[page : page + 4096] = bytes(4096)
    else:
        del content[place:]
    path.write_bytes(content)
    same_or_refused(whole)
    repaired(whole)


def repaired(whole: list[list[float]]) -> None:
    """Require that a repair gives the trials, or says which are gone, or refuses."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            with Campaign.load(FOLDER, repair=True) as c:
                found = facts(c)
                c.attach([1.0], 0.4)
        except (DamagedCampaignError, ValueError) as error:
            assert str(error).startswith("expected"), error
            return
    gone = [row for row in whole if row not in found]
    assert not gone or any("given up" in str(w.message) for w in given), gone
    assert len(Campaign.load(FOLDER).history) == len(found) + 1


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
    cases=("store.lock", "store.db", "store.db-wal", "store.db-shm", "campaign.toml"),
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


@ATTACKS.add("records of another campaign", cases=tuple(RECORDS))
def mixed(name: str) -> None:
    with campaign(directory="other", seed=5) as other:
        for x in (0.1, 0.2):
            other.tell(x, action=[3.0])
        other.update()
    whole = made()
    table = RECORDS[name]
    execute(FOLDER, f"DELETE FROM {table} WHERE kind = ?", name)
    with closing(sqlite3.connect(FOLDER / "store.db", isolation_level=None)) as mine:
        mine.execute("ATTACH ? AS other", ("other/store.db",))
        mine.execute(
            f"INSERT INTO {table} SELECT * FROM other.{table} WHERE kind = ?", (name,)
        )
    same_or_refused(whole)


@ATTACKS.add("the log of another file")
def another_log(_: str) -> None:
    with campaign(directory="other", seed=5) as other:
        for x in (0.1, 0.2):
            other.tell(x, action=[3.0])
        log = Path("other", "store.db-wal").read_bytes()
    assert len(log) > 1000
    whole = made()
    (FOLDER / "store.db-wal").write_bytes(log)
    same_or_refused(whole)
