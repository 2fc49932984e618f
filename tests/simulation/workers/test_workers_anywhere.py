"""Workers of scripts, threads and processes as users write them."""

import subprocess
import sys

import pytest

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


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks")
@pytest.mark.parametrize(
    "rest",
    [
        pytest.param(FORKED, id="forked"),
        pytest.param(THREADS, id="threads", marks=SLOW),
        pytest.param(NESTED, id="nested", marks=SLOW),
        pytest.param(LEFT, id="left", marks=SLOW),
    ],
)
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
