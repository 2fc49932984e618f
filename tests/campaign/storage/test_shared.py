"""Threads, processes and crafted folders: nothing that was told is lost."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from sbi_active import Campaign, GaussianNoise, SimulatorModel
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.simulation.bank import CorruptSegmentError, store
from sbi_active.simulation.bank.store import LogChangedError, Store
from tests.campaign.storage.campaigns import facts, go_on, mean, new
from tests.simulation.bank.filled import FILE, crafted, execute


def told(folder, **options):
    return [t.x.tolist() for t in Campaign.load(folder, **options).history]


def number(k):
    return [0.25 * k] * 4


def test_eight_threads_lose_nothing(tmp_path):
    c = new(tmp_path / "c")
    with ThreadPoolExecutor(8) as threads:
        [*threads.map(lambda k: c.attach([1.0], number(k)), range(40))]
    c.close()
    assert sorted(told(tmp_path / "c")) == [number(k) for k in range(40)]


def test_a_trial_told_while_another_thread_learns_is_kept(tmp_path):
    c = go_on(new(tmp_path / "c"), 1)
    learning = threading.Thread(target=c.ask)
    learning.start()
    c.attach([1.0], number(3))
    learning.join()
    c.close()
    assert number(3) in told(tmp_path / "c")


def test_two_writers_without_locks_refuse_before_they_write(tmp_path, monkeypatch):
    folder = tmp_path / "c"
    a = new(folder)
    a.attach([1.0], number(1))
    b = Campaign.load(folder)

    def unlocked(path, mode, *, timeout):  # as on a file system whose locks do nothing
        own = path.with_name(f"{path.name}-of-b" if path.name == "store.lock" else FILE)
        return connected(own, mode, timeout=timeout)

    with monkeypatch.context() as patch:
        connected = store._connected
        patch.setattr(store, "_connected", unlocked)
        b.attach([1.0], number(2))
    with pytest.raises(LogChangedError, match="trials of another process"):
        a.attach([2.0], number(3))
    assert told(folder) == [number(1), number(2)]


def test_a_lock_file_that_is_removed_cuts_nothing_off(tmp_path):
    folder = tmp_path / "c"
    a = new(folder)
    a.attach([1.0], number(1))
    os.remove(folder / "store.lock")
    b = Campaign.load(folder)
    b.attach([1.0], number(2))
    with pytest.raises(LogChangedError):
        a.attach([2.0], number(3))
    assert told(folder) == [number(1), number(2)]


@pytest.mark.parametrize("harm", ["removed", "cut", "nuls", "another"])
def test_a_file_that_is_harmed_meanwhile_is_not_written_to(tmp_path, harm):
    folder = tmp_path / "c"
    c = new(folder)
    c.attach([1.0], number(1))
    content = (folder / FILE).read_bytes()
    left = {
        "removed": None,
        "cut": content[:5000],
        "nuls": b"\0" * len(content),
        "another": b"hello" * 1000,
    }[harm]
    if harm in ("removed", "another"):
        (folder / FILE).unlink()
    if left is not None:
        (folder / FILE).write_bytes(left)
    with pytest.raises(CorruptSegmentError, match="nothing was written to it now"):
        c.attach([2.0], number(2))
    assert ((folder / FILE).read_bytes() if left is not None else None) == left
    assert len(c.history) == 1  # and the second is not taken for recorded


@pytest.mark.parametrize("harm", ["empty", "uncounted", "older"])
def test_a_log_shorter_than_the_state_is_damage(tmp_path, harm):
    folder = tmp_path / "c"
    go_on(new(folder), 3).close()
    left = {"empty": 0, "uncounted": 0, "older": 1}[harm]
    execute(folder, "DELETE FROM records WHERE kind = 'log' AND number > ?", left)
    if harm != "empty":
        catalog = Store(folder, "campaign").catalog
        crafted(folder, "catalog", 0, {**catalog, "log": left})
    with pytest.raises(CorruptSegmentError):
        Campaign.load(folder)


def test_small_numbers_are_corrected(tmp_path):
    scale = 1e-9
    noise = GaussianNoise(0.1 * scale)
    c = new(tmp_path / "c", SimulatorModel(lambda *p: scale * mean(*p), noise=noise))
    c.attach([1.0], [0.8 * scale] * 4)
    c.correct(0, [2.0 * scale] * 4, reason="typo")
    assert c.history[0].x.tolist() == pytest.approx([2 * scale] * 4, rel=1e-6)
    assert c.tell(c.history[0].x, trial=0) is c.history[0]  # the same, bit for bit
    close = torch.nextafter(c.history[0].x, torch.ones(4))
    assert torch.equal(c.tell(close, trial=0).x, close)


def test_files_of_the_user_stay(tmp_path):
    folder = tmp_path / "c"
    c = new(folder)
    (folder / "belief-mine.bin").write_text("precious")
    go_on(c, 2).close()
    assert (folder / "belief-mine.bin").read_text() == "precious"
    names = {path.name for path in folder.iterdir()}
    assert names == {"belief-mine.bin", "campaign.toml", FILE, "store.lock"}


def test_a_small_file_that_fills_memory_is_refused():
    bomb = encode(torch.zeros(100_000_000 // 4), known={})
    assert len(bomb) < 500_000
    with pytest.raises(ValueError, match="expected what this library stores"):
        decode(bomb, known={})


SPOILS = [None, [], {}, "", -1, 1e300, True, 10**9]
SPOILS += ["\ud800", [[]], {"a": None}, [None] * 3]


@pytest.mark.filterwarnings("ignore")
def test_crafted_files_are_one_error_that_names_the_file(tmp_path):
    """Whatever stands in the place of an entry: the same trials, or one error."""
    folder = tmp_path / "c"
    whole = go_on(new(folder), 1)
    whole.close()
    content = (folder / FILE).read_bytes()
    manifest = whole._storage.manifest
    rng = np.random.default_rng(0)
    changes = []
    for key in manifest:
        spoil = SPOILS[rng.integers(len(SPOILS))]
        changes.append(("campaign", 0, {**manifest, key: spoil}))
    for line, entry in enumerate(whole.events, 1):
        trial = entry.get("trial", {})
        for key in entry:
            spoil = SPOILS[rng.integers(len(SPOILS))]
            changes.append(("log", line, {**entry, key: spoil}))
        for key in trial:
            spoil = {**trial, key: SPOILS[rng.integers(len(SPOILS))]}
            changes.append(("log", line, {**entry, "trial": spoil}))
    assert len(changes) > 30
    survived = 0
    for kind, number, spoiled in changes:
        (folder / FILE).write_bytes(content)
        crafted(folder, kind, number, spoiled)
        try:
            found = Campaign.load(folder)
            found.history, found.health, str(found.belief)  # noqa: B018
            survived += facts(found) == facts(whole)
        except (CorruptSegmentError, LogChangedError):
            survived += 1
        except ValueError as error:  # what a reader has to give again
            survived += str(error).startswith("expected")
    # What describes and decides nothing may hold anything: a reason, a time.
    assert survived >= 0.9 * len(changes)
