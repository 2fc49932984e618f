"""SIGKILL at any moment: the campaign resumes, and ends where it would have ended."""

import contextlib
import os
import random
import signal
import sqlite3
import time

import pytest
import torch

from sbi_active import Campaign
from tests.campaign.storage.campaigns import MODEL, draws, facts, go_on, new

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
NUM_TRIALS, NUM_KILLED = 3, 3


def has_manifest(folder):
    """Return whether a process that was killed had begun the campaign."""
    with contextlib.suppress(ValueError):
        return bool(Campaign.load(folder))
    return False


def run(folder, num_trials=NUM_TRIALS):
    """Begin the campaign or go on with it, as a robot's program would."""
    if has_manifest(folder):
        campaign = Campaign.load(folder, simulator=MODEL)
    else:
        campaign = new(folder)
    return go_on(campaign, num_trials)


def killed(work, after=None, at_call=None):
    """Run a function in a process that is killed; return whether it ended before.

    Args:
        work: The function.
        after: Seconds.
        at_call: Number of the call that makes something durable, on which it dies.
    """
    pid = os.fork()
    if pid == 0:
        if at_call is not None:
            _die_at(at_call)
        work()
        os._exit(0)
    if after is not None:
        time.sleep(after)
        os.kill(pid, signal.SIGKILL)
    return os.waitpid(pid, 0)[1] == 0


def _die_at(number):
    """Have the process killed before the n-th call that reaches the disk."""
    count = [0]

    def die():
        count[0] += 1
        if count[0] == number:
            os.kill(os.getpid(), signal.SIGKILL)

    def dying(function):
        def call(*arguments, **options):
            die()
            return function(*arguments, **options)

        return call

    def traced(statement):
        if statement.startswith(("COMMIT", "PRAGMA wal_checkpoint", "INSERT")):
            die()

    def connect(*arguments, **options):
        connection = connected(*arguments, **options)
        connection.set_trace_callback(traced)
        return connection

    connected, sqlite3.connect = sqlite3.connect, connect
    os.fsync, os.replace = dying(os.fsync), dying(os.replace)


def told_of(folder):
    entries = Campaign.load(folder).events if has_manifest(folder) else []
    return [entry["trial"] for entry in entries if entry["event"] == "told"]


@pytest.fixture(scope="module")
def whole():
    return go_on(new(), NUM_TRIALS)


@pytest.mark.parametrize("how", ["by the clock", "at the disk"])
def test_killed_again_and_again_and_resumed(tmp_path, how, whole):
    rng = random.Random(0)
    num_killed = num_campaigns = 0
    while num_killed < NUM_KILLED:
        folder, told, ended = tmp_path / f"c{num_campaigns}", [], False
        while num_killed < NUM_KILLED and not ended:
            if how == "by the clock":
                moment = {"after": rng.uniform(0.02, 0.4)}
            else:
                moment = {"at_call": rng.randint(1, 45)}
            ended = killed(lambda folder=folder: run(folder), **moment)
            num_killed += not ended
            now = told_of(folder)
            assert now[: len(told)] == told  # what was told is never lost
            told = now
        campaign = run(folder)
        assert torch.equal(draws(campaign), draws(whole))
        assert facts(campaign) == facts(whole)
        assert len(told_of(folder)) == NUM_TRIALS
        num_campaigns += 1


@pytest.fixture(scope="module")
def two_rounds():
    return go_on(new(), 2)


@pytest.mark.parametrize("at_call", range(1, 60, 7))
def test_killed_at_each_write_of_a_round(tmp_path, at_call, two_rounds):
    """A first round, from the manifest on, dies at each of its writes in turn."""
    folder = tmp_path / "c"
    killed(lambda: go_on(new(folder), 1), at_call=at_call)
    campaign = run(folder, 2)
    assert torch.equal(draws(campaign), draws(two_rounds))
    assert facts(campaign) == facts(two_rounds)


def learn(campaign):
    campaign.update()
    return campaign


def attached(folder=None):
    campaign = new(folder)
    campaign.attach([0.8], [0.3, 0.5, 0.7, 0.8])
    campaign.attach([1.9], [0.6, 0.8, 1.0, 1.2])
    return campaign


@pytest.fixture(scope="module")
def apart():
    return learn(attached())


@pytest.mark.parametrize("at_call", range(3, 60, 7))
def test_killed_while_several_trials_are_learned(tmp_path, at_call, apart):
    folder = tmp_path / "c"
    attached(folder).close()
    killed(lambda: learn(Campaign.load(folder, simulator=MODEL)), at_call=at_call)
    campaign = learn(Campaign.load(folder, simulator=MODEL))
    assert torch.equal(draws(campaign), draws(apart))
    assert facts(campaign) == facts(apart)
