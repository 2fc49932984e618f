import gc
import signal
from dataclasses import replace

import pytest
import torch

from sbi_active.criticism import next_action

# A shell that starts the tests in the background has SIGINT ignored, which children
# inherit: those that a test interrupts would never end.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Before OpenMP has threads of its own, for which a forked child would wait forever.
torch.set_num_threads(1)


def pytest_collection_finish():
    """Have the collector pass over what was imported: a million objects, each time."""
    gc.freeze()


@pytest.fixture
def few_draws(monkeypatch):
    """Have the next action be planned by few draws of each rival."""
    monkeypatch.setattr(next_action, "PLAN", replace(next_action.PLAN, samples=40))


@pytest.fixture(autouse=True)
def _seeded_and_clean(tmp_path, tmp_path_factory, monkeypatch):
    """Each test starts from the same generator and leaves no folder behind."""
    torch.manual_seed(0)
    monkeypatch.chdir(tmp_path)
    state = tmp_path_factory.getbasetemp() / "state"  # not the home of who tests
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    yield
    assert not (tmp_path / "sbi-logs").exists()
