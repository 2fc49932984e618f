import errno
import os
import resource
import shutil
import subprocess
from functools import partial

import numpy as np
import pytest
import torch

from sbi_active import Bank, SimulatorModel, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import Simulations
from sbi_active.simulation.fingerprint import fingerprint, require_same
from tests.simulation.bank.filled import append, execute


def simulator(theta, action, seeds):
    return theta + row_normals(seeds, 2).float()


class Rail:
    def __init__(self, setting):
        self.setting, self._cache = setting, object()

    def __call__(self, theta, action):
        return theta


def rows(num_rows=100):
    return Simulations(*(torch.rand(num_rows, dim) for dim in (2, 1, 2)))


@pytest.fixture
def bank(tmp_path):
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        append(bank, rows(), 0)
        append(bank, rows(), 1)
        yield bank


def test_a_bank_of_another_simulator(tmp_path):
    for seed in range(2):
        with Bank(tmp_path / "bank", simulator=Rail(1.0)) as bank:
            append(bank, rows(), seed)
    text = "got another: .*simulator.setting 1.0 there, 2.0 here.*; give the one"
    with pytest.raises(ValueError, match=text):
        Bank(tmp_path / "bank", simulator=Rail(2.0))


def test_version_stands_for_the_source(tmp_path):
    def make(text):
        (tmp_path / "source.py").write_text(text)
        scope = {"__name__": "source"}
        exec(compile(text, str(tmp_path / "source.py"), "exec"), scope)
        import linecache

        linecache.checkcache()
        return scope["f"]

    before = make("def f(theta, action):\n    return theta\n")
    old, old_version = fingerprint(before), fingerprint(before, version="1")
    after = make("def f(theta, action):\n    return theta + 1\n")
    with pytest.raises(ValueError, match="of it; got another: simulator.source"):
        require_same("it", old, fingerprint(after))
    require_same("it", old_version, fingerprint(after, version="1"))
    with pytest.raises(ValueError, match="another: version '1' there, '2' here;"):
        require_same("it", old_version, fingerprint(after, version="2"))


def made(scale, power=2):
    def scaled(theta, action, shift=0.0):
        return scale * theta**power + shift

    return scaled


#: What makes a simulator, and two settings of it.
SETTINGS = [
    (Rail, np.float32(1.0), np.float32(2.0)),
    (Rail, {"ice"}, {"ice", "steel"}),
    (Rail, 1j, 2j),
    (Rail, b"a", b"b"),
    (Rail, torch.ones(2).bfloat16(), torch.zeros(2).bfloat16()),
    (made, 2.0, 3.0),
    (partial(made, 2.0), 2, 3),
]


@pytest.mark.parametrize(("make", "one", "other"), SETTINGS)
def test_settings_and_captured_variables_of_any_kind_are_seen(make, one, other):
    before = fingerprint(make(one))
    require_same("it", before, fingerprint(make(one)))
    text = "another: simulator.setting " if make is Rail else "got another"
    with pytest.raises(ValueError, match=text):
        require_same("it", before, fingerprint(make(other)))


@pytest.mark.parametrize("of", [lambda f: f, Rail, lambda f: Rail(f).__call__])
def test_defaults_partial_functions_and_methods(of):
    def pushed(theta, action, force=1.0):
        return theta

    whole, part = of(pushed), of(partial(pushed, force=2.0))
    before = [fingerprint(simulator) for simulator in (whole, part)]
    for k, value in enumerate((whole, part)):
        require_same("it", before[k], fingerprint(value))
    other = of(partial(pushed, force=3.0))
    pushed.__defaults__ = (1.5,)
    for k, value in enumerate((whole, other)):
        with pytest.raises(ValueError, match="got another"):
            require_same("it", before[k], fingerprint(value))


def test_source_of_the_library_changes_from_release_to_release():
    model = SimulatorModel(Rail(1.0))
    before = fingerprint(model)
    before["simulator"]["source"] = "that of another release"
    require_same("it", before, fingerprint(model))


def test_other_formats_and_folders(bank, tmp_path):
    bank.close()
    execute(bank.path, "PRAGMA user_version = 99")
    with pytest.raises(ValueError, match="expected a bank of format 4; got 99"):
        Bank(bank.path)
    with pytest.raises(ValueError, match=r"got no .*store.db; check the path"):
        Bank(tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (tmp_path / "notes").touch()
    with pytest.raises(OSError, match="expected a folder; got .*; choose another"):
        Bank(tmp_path / "notes" / "bank", simulator=simulator)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"an empty folder .* with \['thesis.tex'\]"):
        Bank(tmp_path / "full", simulator=simulator)


def full_disk(folder):
    """Return whether a small file system could be mounted."""
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or shutil.which("mount") is None:
        return False
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.fixture
def small_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    if not full_disk(folder):
        pytest.skip("only root can mount a small file system here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk(small_disk):
    theta, action = torch.rand(200_000, 2), torch.rand(200_000, 1)
    few = Simulations(theta[:100], action[:100], theta[:100])
    with Bank(small_disk / "bank", simulator=simulator) as bank:
        append(bank, few, 0)
        text = "expected to read and write; got '.*database or disk is full'; make room"
        with pytest.raises(OSError, match=text) as raised:
            simulate(simulator, theta, action, seed=1, store=bank)
        assert raised.value.errno == errno.ENOSPC
        Bank(bank.path).verify()
        assert torch.equal(bank.read(slice(0, 100)).theta, theta[:100])
        # With room again, what was stored is gone on with.
        before = len(bank)
        simulate(simulator, theta[:100], action[:100], seed=2, store=bank)
        assert len(bank) == before + 100


def test_a_limit_on_file_sizes(bank):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match="got '.*disk I/O error'; make room"):
            append(bank, rows(5_000), 3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(bank) == 200
    bank.verify()
    append(bank, rows(5_000), 3)
    assert len(bank) == 5_200


def test_a_folder_that_cannot_be_written(small_disk):
    with Bank(small_disk / "bank", simulator=simulator) as bank:
        append(bank, rows(), 0)
    remount = ["mount", "-o", "remount,ro", str(small_disk)]
    subprocess.run(remount, check=True)
    assert len(Bank(small_disk / "bank").read()) == 100
    with pytest.raises(OSError, match=r"got '.*read.*only.*'; make room or choose"):
        append(Bank(small_disk / "bank", simulator=simulator), rows(), 1)
    with pytest.raises(OSError, match="Read-only file"):
        Bank(small_disk / "new", simulator=simulator)


def test_a_bank_that_reads_does_not_write(bank):
    with pytest.raises(ValueError, match="opened with its simulator, to write to"):
        append(Bank(bank.path), rows(), 5)
