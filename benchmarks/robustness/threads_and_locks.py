"""Attacks on a campaign that several threads, processes or hosts use at once."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.campaign_problem import campaign, tell
from sbi_active import Campaign
from sbi_active.campaign.storage import DamagedCampaignError
from sbi_active.campaign.storage.damage import LogChangedError
from sbi_active.simulation.bank import LockedError, store

ATTACKS = Attacks()
FOLDER = "camp"
FILE = Path(FOLDER, "store.db")
REFUSED = (DamagedCampaignError, LockedError, LogChangedError)


def begun(**changes: Any) -> Campaign:
    """Return a campaign on disk."""
    return campaign(directory=FOLDER, **changes)


def numbers(c: Campaign) -> list[float]:
    """Return the outcomes of a campaign."""
    return [float(t.x[0]) for t in c.history if t.x is not None]


def told() -> list[float]:
    """Return all numbers that the folder holds, in order."""
    return sorted(numbers(Campaign.load(FOLDER)))


def require_told(numbers: list[float]) -> None:
    """Require exactly these numbers on disk."""
    found = told()
    assert len(found) == len(numbers), (len(found), len(numbers))
    assert all(
        abs(a - b) < 1e-6 for a, b in zip(found, sorted(numbers), strict=True)
    ), found


@ATTACKS.add("threads tell at once", cases=[(k, n) for k in (2, 8, 32) for n in (1, 5)])
def threads_tell(case: tuple[int, int]) -> None:
    num_threads, each = case
    c = begun()

    def work(k: int) -> None:
        for i in range(each):
            c.attach([1.0], 0.01 * (k * each + i))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(num_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    c.close()
    require_told([0.01 * i for i in range(num_threads * each)])


@ATTACKS.add(
    "a thread tells while another works",
    cases=("ask", "update", "correct", "withdraw", "history"),
)
def beside(what: str) -> None:
    c = tell(begun())
    calls = {
        "ask": c.ask,
        "update": c.update,
        "correct": lambda: c.correct(0, 0.6, reason="typo"),
        "withdraw": lambda: c.withdraw(0, reason="slipped"),
        "history": lambda: [str(c.history) for _ in range(50)],
    }
    other = threading.Thread(target=calls[what])
    other.start()
    for k in range(5):
        c.attach([1.0], 0.1 * k)
    other.join()
    c.close()
    found = Campaign.load(FOLDER).history
    for k in range(5):
        assert any(t.x is not None and abs(float(t.x) - 0.1 * k) < 1e-6 for t in found)


def _process(start: int, num: int, gate: Any, out: Any) -> None:
    gate.wait()
    done = []
    for k in range(start, start + num):
        for _ in range(200):
            try:
                with Campaign.load(FOLDER) as c:
                    c.attach([1.0], 0.01 * k)
                done.append(k)
                break
            except REFUSED:
                time.sleep(0.02)
    out.put(done)


@ATTACKS.add("processes tell in turn", cases=(2, 4), seconds=240.0)
def processes(num: int) -> None:
    begun().close()
    context = multiprocessing.get_context("fork")
    gate, out = context.Event(), context.Queue()
    made = [
        context.Process(target=_process, args=(10 * p, 4, gate, out))
        for p in range(num)
    ]
    for process in made:
        process.start()
    gate.set()
    kept = [k for _ in made for k in out.get(timeout=200)]
    for process in made:
        process.join()
    require_told([0.01 * k for k in kept])
    assert kept


@ATTACKS.add(
    "two writers where locks do nothing",
    cases=[(lead, late) for lead in (1, 2, 5) for late in ("attach", "tell", "ask")],
)
def without_locks(case: tuple[int, str]) -> None:
    lead, late = case
    count = itertools.count()
    connected = store.connected

    def unlocked(path: Path, mode: str, *, timeout: float) -> Any:
        return connected(path.with_suffix(f".{next(count)}"), mode, timeout=timeout)

    store.connected = unlocked  # each has a lock of its own
    a = begun()
    a.attach([1.0], 0.5)
    b = Campaign.load(FOLDER)
    expected = [0.5]
    for k in range(lead):
        b.attach([1.0], 0.01 * k)
        expected.append(0.01 * k)
    calls = {
        "attach": lambda: a.attach([1.0], 0.9),
        "tell": lambda: a.tell(0.9, action=[1.0]),
        "ask": a.ask,
    }
    try:
        calls[late]()
    except REFUSED:
        pass
    else:
        raise AssertionError("written over another writer's file")
    require_told(expected)


@ATTACKS.add(
    "a lock file that somebody removes", cases=("before", "between", "and makes anew")
)
def lock_removed(when: str) -> None:
    a = begun()
    a.attach([1.0], 0.1)
    lock = Path(FOLDER, "store.lock")
    lock.unlink(missing_ok=True)
    if when == "and makes anew":
        lock.write_text("")
    b = Campaign.load(FOLDER)
    expected = [0.1]
    if when != "before":
        try:
            b.attach([1.0], 0.2)
            expected.append(0.2)
        except REFUSED:
            pass
    try:
        a.attach([1.0], 0.3)
        expected.append(0.3)
    except REFUSED:
        pass
    require_told(expected)


@ATTACKS.add(
    "a file that changes under a running campaign",
    cases=("removed", "empty", "cut", "nuls", "longer", "text", "a folder"),
)
def log_harmed(harm: str) -> None:
    c = begun()
    c.attach([1.0], 0.1)
    c.attach([1.0], 0.2)
    content = FILE.read_bytes()
    FILE.unlink()
    harmed = {
        "removed": None,
        "empty": b"",
        "cut": content[: len(content) // 3],
        "nuls": b"\0" * len(content),
        "longer": content + b"{}\n",
        "text": b"hello",
        "a folder": None,
    }[harm]
    if harm == "a folder":
        FILE.mkdir()
    if harmed is not None:
        FILE.write_bytes(harmed)
    try:
        c.attach([1.0], 0.3)
    except (*REFUSED, OSError):
        pass
    else:
        raise AssertionError("written to a log that is not its own")
    after = FILE.read_bytes() if FILE.is_file() else None
    assert after == harmed
    assert len(c.history) == 2


@ATTACKS.add(
    "a process that forked", cases=("attach", "tell", "correct", "exits", "asks")
)
def forked(what: str) -> None:
    parent = begun()
    parent.attach([1.0], 0.1)
    child = os.fork()
    if child == 0:
        code = 0
        try:
            calls = {
                "attach": lambda: parent.attach([1.0], 0.2),
                "tell": lambda: parent.tell(0.2, action=[1.0]),
                "correct": lambda: parent.correct(0, 0.2, reason="typo"),
                "exits": lambda: sys.exit(0),
                "asks": parent.ask,
            }
            calls[what]()
        except (*REFUSED, SystemExit):
            code = 1
        os._exit(code)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 1
    parent.attach([1.0], 0.3)
    parent.close()
    require_told([0.1, 0.3])


KILLED = """
import sys
from benchmarks.robustness.campaign_problem import campaign
c = campaign(directory="camp")
for k in range(1000):
    c.attach([1.0], 0.001 * k)
    print(k, flush=True)
"""


@ATTACKS.add(
    "a process killed while it tells",
    cases=[
        (name, after)
        for name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
        for after in (1, 4, 9)
    ],
)
def killed(case: tuple[str, int]) -> None:
    name, after = case
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", KILLED]
    environment = {**os.environ, "PYTHONPATH": root}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment
    ) as child:
        assert child.stdout is not None
        for _ in range(after):
            child.stdout.readline()
        child.send_signal(getattr(signal, name))
        rest = child.stdout.read().split()
        child.wait()
    num = after + len(rest)
    with Campaign.load(FOLDER) as c:
        found = [round(x / 0.001) for x in numbers(c)]
        assert found in ([*range(num)], [*range(num + 1)]), (num, found)
        c.attach([1.0], 0.5)
    assert len(told()) == len(found) + 1
