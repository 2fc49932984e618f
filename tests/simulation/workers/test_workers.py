"""Worker processes: kept while they are of use, and gone afterwards."""

import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import cloudpickle
import pytest
import torch

from sbi_active import simulate
from sbi_active.simulation import MissingRowsWarning, Workers
from sbi_active.simulation.workers.pools import waiting_workers

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads /proc"
)

ROWS = torch.arange(8.0)[:, None], torch.zeros(8, 1)


def pids_of_rows(theta, action, seeds):
    time.sleep(0.01)  # so that each worker has its share
    return torch.full((len(theta), 1), float(os.getpid()))


def other_pids(theta, action, seeds):
    return pids_of_rows(theta, action, seeds)


def workers_of(simulator, num_workers=2):
    rows = simulate(simulator, *ROWS, seed=0, workers=num_workers, batch_size=1)
    return set(rows.x.flatten().int().tolist())


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def are_gone(pids, seconds=5.0):
    deadline = time.monotonic() + seconds
    while any(map(is_alive, pids)) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not any(map(is_alive, pids))


@pytest.fixture(autouse=True)
def none_before():
    waiting_workers.cache_clear()
    yield
    waiting_workers.cache_clear()


def test_workers_are_kept_for_the_same_simulator(monkeypatch):
    first = workers_of(pids_of_rows)
    assert len(first) == 2
    assert workers_of(pids_of_rows) == first
    more = workers_of(pids_of_rows, num_workers=3)
    assert more > first
    other = workers_of(other_pids)
    assert not other & more
    assert are_gone(more)
    # A change of the environment needs others, too.
    monkeypatch.setenv("SOME_SETTING", "new")
    assert not workers_of(other_pids) & other
    assert are_gone(other)


def test_a_worker_that_dies_while_it_waits_costs_no_row():
    pids = workers_of(pids_of_rows)
    os.kill(min(pids), signal.SIGKILL)
    assert are_gone([min(pids)])
    with warnings.catch_warnings():
        warnings.simplefilter("error", MissingRowsWarning)
        again = workers_of(pids_of_rows)
    assert max(pids) in again
    assert min(pids) not in again


def test_what_a_worker_started_ends_with_it(tmp_path):
    def simulator(theta, action, seeds):
        child = subprocess.Popen(["sleep", "60"])
        (tmp_path / f"{int(theta[0])}").write_text(f"{os.getpid()} {child.pid}")
        if theta[0] == 1:
            child.wait()
        return theta

    few = [rows[:3] for rows in ROWS]
    with pytest.warns(MissingRowsWarning, match="1 of 3 rows are missing: 1 timed out"):
        simulate(simulator, *few, seed=0, workers=Workers(time_limit=0.3), batch_size=1)

    def pids_of(row):
        return {*map(int, (tmp_path / f"{row}").read_text().split())}

    assert are_gone(pids_of(1))
    assert all(map(is_alive, pids_of(2)))  # the next simulation may need them
    waiting_workers.cache_clear()
    assert are_gone(pids_of(0) | pids_of(2))
    assert len(pids_of(0) | pids_of(1) | pids_of(2)) == 5  # two workers


SCRIPT = """
import os, sys, time, torch
from sbi_active import simulate

def simulator(theta, action, seeds):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(0.01 if sys.argv[1] == "end" else 60)
    return theta

if __name__ == "__main__":
    if sys.argv[1] == "forked":  # a child that holds what this process has open
        import threading
        def fork():
            if os.fork() == 0:
                time.sleep(8)
                os._exit(0)
        threading.Timer(1.0, fork).start()
    theta = torch.rand(6, 1)
    simulate(simulator, theta, theta, seed=0, workers=2, batch_size=1)
"""


#: How the parent ends.
WAYS = [
    "kill",
    pytest.param("group", marks=pytest.mark.slow),
    pytest.param("nest", marks=pytest.mark.slow),
    pytest.param("end", marks=pytest.mark.slow),
    pytest.param("forked", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("way", WAYS)
def test_workers_die_with_their_parent_and_silently(way, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with (tmp_path / "errors").open("w+") as errors:
        parent = subprocess.Popen(
            [sys.executable, script, way],
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
        )
        pids = {int(parent.stdout.readline()) for _ in range(2)}
        stats = [Path(f"/proc/{pid}/stat").read_text().split() for pid in pids]
        nests = {int(stat[3]) for stat in stats}
        assert len(nests) == 1
        ended_by = signal.SIGKILL
        if way == "kill":
            parent.kill()
        elif way == "forked":
            time.sleep(1.5)
            parent.kill()
        elif way == "group":  # as a terminal or a batch system does
            ended_by = signal.SIGTERM
            os.killpg(parent.pid, ended_by)
        elif way == "nest":  # the process that forks them is lost
            os.kill(min(nests), signal.SIGKILL)
            assert are_gone(pids)
            parent.kill()
        pids |= nests
        assert parent.wait(20) == (0 if way == "end" else -ended_by)
        assert are_gone(pids)
        parent.stdout.close()
        errors.seek(0)
        assert errors.read() == ""


# Workers of scripts, threads and processes as users write them


# No script has a guard: workers must not run it again.
START = """
import os, threading, time, torch
from sbi_active import simulate

print("started", flush=True)
scale = 2.0
theta = torch.rand(20, 1)

def simulator(theta, action, seeds):
    return theta * scale

def go(shift=None):
    x = simulate(simulator, theta, theta, seed=0, workers=2).x
    assert torch.equal(x, theta * 2)
    if shift is not None:
        shifted = lambda theta, action, seeds: theta + shift
        x = simulate(shifted, theta, theta, seed=0, workers=2).x
        assert torch.equal(x, theta + shift)

go()
"""

FORKED = """
child = os.fork()
if child == 0:
    go()
    raise SystemExit(0)
assert os.waitpid(child, 0)[1] == 0
go()
"""

THREADS = """
threads = [threading.Thread(target=go, args=(float(i),)) for i in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
go()
"""

NESTED = """
def outer(theta, action, seeds):
    return simulate(simulator, theta, theta, seed=0, workers=2).x

x = simulate(outer, theta, theta, seed=0, workers=2, batch_size=10).x
assert torch.equal(x, theta * 2)
"""

LEFT = """
def endless(theta, action, seeds):
    time.sleep(60)

work = lambda: simulate(endless, theta, theta, seed=0, workers=2)
threading.Thread(target=work, daemon=True).start()
time.sleep(0.5)
"""

SLOW = pytest.mark.slow


#: What a script goes on with.
RESTS = [
    pytest.param(FORKED, id="forked"),
    pytest.param(THREADS, id="threads", marks=SLOW),
    pytest.param(NESTED, id="nested", marks=SLOW),
    pytest.param(LEFT, id="left", marks=SLOW),
]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks")
@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize("way", ["file", pytest.param("input", marks=SLOW)])
def test_workers_run_no_script_again_and_end_silently(way, rest, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(START + rest)
    ended = subprocess.run(
        [sys.executable, script if way == "file" else "-"],
        input=None if way == "file" else START + rest,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "started\n", "")
