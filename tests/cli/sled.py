"""A sled's simulator, and the words that make a campaign of it."""

import contextlib
import json
import locale
import os
import subprocess
import sys

import pytest

from sbi_active.campaign.telling import SUMMARY
from sbi_active.cli import main
from sbi_active.simulation.bank.store import Store

SIMULATOR = """
import torch


def slide(theta, action):
    friction, drag = theta[:, :1], theta[:, 1:]
    return action**2 / (2 * 9.81 * friction) / (1 + drag * action)
"""
BOX = ["--theta-low=0.2,0", "--theta-high=1,1"]
SIZES = ["num_simulations=200", "details.num_scored=500", "network=on demand"]
SIZES += ["refinement.num_histories=200", "refinement.num_effective=25"]
SMALL = ["--noise", "0.02", "--method", "nsbi", *(f"--set={s}" for s in SIZES)]
INIT = ["init", "camp", *BOX, *SMALL, "--actions", "0.5:3", "--simulator"]


def made_at(places, simulator, *told, more=()):
    """Return a new folder with a campaign of a trial that was told and one to come."""
    place = places.mktemp("sled")
    (place / "sled.py").write_text(simulator)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setenv("XDG_STATE_HOME", str(places.getbasetemp() / "state"))
        patch.setattr(sys, "path", [*sys.path])
        patch.delitem(sys.modules, "sled", raising=False)
        assert main([*INIT, "sled.py:slide", *more]) == 0
        assert main(["tell", "camp", *told, "--action", "1"]) == 0
        assert main(["ask", "camp"]) == 0
    return place


def run(words, *, flags=(), env=(), **options):
    """Return a call in a process of its own, as a shell makes it."""
    code = "import sys; from sbi_active.cli import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, *flags, "-c", code, *words],
        env={**os.environ, "OMP_NUM_THREADS": "1", **dict(env)},
        **{"stderr": subprocess.PIPE, "text": True, **options},
    )


def forked(words, place="", **options):
    """Return a call in a process that has imported all that this one has."""

    def call():
        os.closerange(3, 4_096)  # the pipe of Popen among them
        locale.setlocale(locale.LC_ALL, place)
        sys.stdin, sys.stdout = os.fdopen(0), os.fdopen(1, "w")
        sys.stderr = os.fdopen(2, "w", buffering=1)
        status = 1
        try:
            status = main([*words])
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            os._exit(status)

    pipes = {"stderr": subprocess.PIPE, "text": True, **options}
    return subprocess.Popen([sys.executable], preexec_fn=call, **pipes)


def forget(folder, content=None):
    """Have a folder's summary be another one, or none."""
    with contextlib.closing(Store(folder, "campaign")) as store, store.writing():
        store.put(SUMMARY, content or b"{}")


def read(text):
    """Return what a line of strict JSON says."""
    return json.loads(text, parse_constant=_refuse)


def _refuse(constant):
    raise AssertionError(f"{constant} is no JSON")
