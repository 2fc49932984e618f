import signal
import time
import warnings
from contextlib import contextmanager
from multiprocessing import get_context

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import Simulations, reuse
from sbi_active.simulation.bank import LockedError
from sbi_active.simulation.bank import bank as module
from tests.simulation.bank.filled import append


def simulator(theta, action, seeds):
    x = theta[:, :1] * action + row_normals(seeds, 3).float()
    return torch.where(theta[:, :1] > 0.1, x, torch.nan)  # a tenth is invalid


def draw(num_rows):
    return torch.rand(num_rows, 2), torch.rand(num_rows, 1)


SOME = Simulations(*draw(3), torch.rand(3, 3))


@contextmanager
def forked(function):
    """Yield a process of a function's own, which needs no imports and has to end."""
    process = get_context("fork").Process(target=function)
    process.start()
    try:
        yield process
        process.join()
        assert process.exitcode in (0, -signal.SIGKILL)
    finally:
        process.kill()


@pytest.fixture
def bank(tmp_path):
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        yield bank


def same(a, b):
    rows = [[s.theta, s.action, s.x.nan_to_num(nan=-99.0), s.status] for s in (a, b)]
    return all(torch.equal(*pair) for pair in zip(*rows, strict=True))


@pytest.mark.parametrize("num", [300, 1])
def test_what_is_stored_is_not_simulated_again(tmp_path, num):
    calls = []

    def counted(theta, action, seeds):
        calls.append(len(theta))
        return simulator(theta, action, seeds)

    theta, action = draw(num)
    with Bank(tmp_path / "bank", simulator=counted, version="1") as bank:
        first = simulate(counted, theta, action, seed=0, store=bank)
    del calls[:]
    with Bank(tmp_path / "bank", simulator=counted, version="1") as bank:
        assert same(simulate(counted, theta, action, seed=0, store=bank), first)
        assert not calls
        assert len(bank) == num
        simulate(counted, theta, action, seed=1, store=bank)
        assert len(bank) == 2 * num
        assert sum(calls) == num


def test_rows_by_position_slice_and_mask(bank, monkeypatch):
    monkeypatch.setattr(module, "SEGMENT_BYTES", 45 * 60)  # about 60 rows a segment
    rows = simulate(simulator, *draw(200), seed=0)
    for _ in range(2):  # rows that are stored already are left as they are
        append(bank, rows, 0)
    assert len(bank._segments()) > 2
    some = torch.tensor([199, 3, 3, 70])
    assert torch.equal(bank.read(some).theta, rows.theta[some])
    assert torch.equal(bank.read(slice(50, 150)).theta, rows.theta[50:150])
    mask = rows.theta[:, 0] > 0.5
    assert torch.equal(bank.read(mask).theta, rows.theta[mask])
    assert len(bank.read(slice(0, 0))) == 0
    assert torch.equal(bank.read([-1, 0]).x, rows.x[[-1, 0]])
    for bad in ([200], [-201], [0.5]):
        with pytest.raises(IndexError):
            bank.read(bad)


def test_the_file_alone_holds_all_once_it_is_closed(bank, tmp_path):
    simulate(simulator, *draw(40), seed=0, store=bank)
    reader = Bank(bank.path)
    assert len(reader) == 40
    bank.close()
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "store.db").write_bytes((bank.path / "store.db").read_bytes())
    assert same(Bank(tmp_path / "copy").read(), reader.read())


def test_several_banks_in_one_file(tmp_path):
    with Bank(tmp_path, simulator=simulator, name="a") as bank:
        simulate(simulator, *draw(4), seed=0, store=bank)
    with Bank(tmp_path, simulator=draw, name="b") as other:
        append(other, Simulations(*draw(3), torch.rand(3, 7)), 0)
    assert [len(Bank(tmp_path, name=name)) for name in "ab"] == [4, 3]
    with pytest.raises(ValueError, match="expected the bank rows in .* bank a, bank b"):
        Bank(tmp_path)


def test_readers_go_on_while_another_process_writes(bank):
    def write():
        own = Bank(bank.path, simulator=simulator)
        for seed in range(60):
            theta = torch.full((10, 1), float(seed))
            append(own, Simulations(theta, theta, theta), seed)
            time.sleep(0.002)  # however fast the disk is, a reader comes in between

    lengths = []
    with forked(write) as writer:
        while writer.is_alive():
            reader = Bank(bank.path)
            lengths.append(len(reader))
            rows = slice(0, lengths[-1])
            if lengths[-1]:
                expected = torch.arange(lengths[-1] // 10).repeat_interleave(10)
                assert torch.equal(reader.read(rows).x[:, 0], expected.float())
            time.sleep(0.002)  # the writer needs the disk too
    assert lengths == sorted(lengths)
    assert len({*lengths}) > 2  # the reader did see the bank grow
    assert len(bank) == 600


def test_a_reader_sees_one_state_of_the_file_at_a_time(bank):
    reader, rows = Bank(bank.path), simulate(simulator, *draw(10), seed=0)
    with reader._store.reading():
        assert len(reader) == 0
        append(bank, rows, 0)
        assert len(reader) == 0
        assert reader._store.get("rows", 1) is None  # and is no gap
    assert len(reader) == 10


def test_shapes_set_by_another_writer_hold(bank):
    late = Bank(bank.path, simulator=simulator)
    append(bank, Simulations(*draw(3), torch.rand(3, 3)), 0)
    bank.close()
    with late, pytest.raises(ValueError, match=r"'x': \[3\]}, as in the bank"):
        append(late, Simulations(*draw(3), torch.rand(3, 4)), 1)


def test_the_lock_goes_with_its_process(bank):
    def hold():
        own = Bank(bank.path, simulator=simulator)
        append(own, SOME, 0)
        time.sleep(60)

    with forked(hold) as holder:
        other = Bank(bank.path, simulator=simulator)
        while not len(other):
            assert holder.is_alive()
        with pytest.raises(LockedError, match="expected no other writer"):
            append(other, SOME, 0)
        holder.kill()
        holder.join()
        assert holder.exitcode == -signal.SIGKILL
        append(other, SOME, 0)
        other.close()


def test_a_forked_child_reads_and_has_no_right_to_write(bank):
    rows = simulate(simulator, *draw(10), seed=0, store=bank)
    reader = Bank(bank.path)
    assert len(reader) == 10

    def work():
        assert same(reader.read(), rows)
        assert same(bank.read(), rows)
        with pytest.raises(LockedError, match="expected no other writer"):
            append(bank, rows, 1)

    with forked(work) as reading:
        reading.join()
        assert reading.exitcode == 0
    assert append(bank, rows, 2) == 10
    with pytest.raises(LockedError):  # the child's end gave nothing back
        append(Bank(bank.path, simulator=simulator), rows, 3)
    bank.close()

    def write():
        with bank:
            assert append(bank, rows, 4) == 10

    with forked(write) as writing:
        writing.join()
        assert writing.exitcode == 0
    assert len(reader) == len(bank) == 30


def test_what_is_stored_is_synchronized_with_the_disk(bank):
    append(bank, simulate(simulator, *draw(10), seed=0), 0)
    with bank._store.reading() as connection:
        found = [
            connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("synchronous", "journal_mode", "trusted_schema")
        ]
    assert found == [2, "wal", 0]  # 2: an fsync at each commit


def test_the_log_does_not_grow_by_what_is_written(bank):
    log = bank._store.path.with_name("store.db-wal")
    rows = simulate(simulator, *draw(10), seed=0)
    sizes = {append(bank, rows, seed) and log.stat().st_size for seed in range(20)}
    assert sizes == {2**20}
    Bank(bank.path).verify()
    bank.close()
    assert not log.exists()


def test_a_log_that_nothing_was_written_to_is_empty(bank):
    append(bank, simulate(simulator, *draw(10), seed=0), 0)
    bank.close()
    bank._store.path.with_name("store.db-wal").write_bytes(bytes(2**20))
    assert len(Bank(bank.path)) == 10
    Bank(bank.path).verify()
    append(bank, simulate(simulator, *draw(10), seed=1), 1)
    assert len(Bank(bank.path)) == 20


# Rows that are weighted for another belief


NOISE = 0.3


def noisy(theta, action, seeds):
    return theta + action + NOISE * row_normals(seeds, 1).float()


def normal(mean, sd):
    return Independent(Normal(torch.tensor([mean]), torch.tensor([sd])), 1)


PRIOR, ROUND = normal(0.0, 2.0), normal(3.0, 1.0)
TARGET = normal(1.0, 0.5)


@pytest.fixture
def both(tmp_path):
    """Rows of both proposals, at two actions."""
    with Bank(tmp_path / "both", simulator=noisy) as both:
        for proposal in (PRIOR, ROUND):
            theta = proposal.sample((2_000,))
            action = torch.randint(2, (2_000, 1)).float()
            store = both.drawn_from(proposal)
            simulate(noisy, theta, action, seed=0, store=store)
        yield both


def z_score(values, weights, exact):
    """Return the error of a weighted mean in its own standard errors."""
    mean = (weights * values).sum()
    error = (weights**2 * (values - mean) ** 2).sum().sqrt()
    return float((mean - exact) / error)


def test_weighted_rows_have_the_law_of_the_target(both):
    reused = reuse(both, TARGET)
    rows = reused.simulations()
    theta, weights = rows.theta[:, 0].double(), reused.weights
    assert float(weights.sum()) == pytest.approx(1)
    assert len(reused) == 4_000
    assert abs(z_score(theta, weights, 1.0)) < 4
    assert abs(z_score((theta - 1) ** 2, weights, 0.25)) < 4
    for action in (0.0, 1.0):
        some = rows.action[:, 0] == action
        w = weights[some] / weights[some].sum()
        x = rows.x[some, 0].double()
        assert abs(z_score(x, w, 1 + action)) < 4
        assert abs(z_score((x - 1 - action) ** 2, w, 0.25 + NOISE**2)) < 4
    # Negative control: the same rows, unweighted.
    equal = torch.full_like(weights, 1 / len(weights))
    assert abs(z_score(theta, equal, 1.0)) > 10


def test_few_effective_rows_are_told(both):
    far = normal(-7.5, 0.3)
    with pytest.warns(UserWarning, match=r"4000 rows of the bank are worth \d+\.\d"):
        reused = reuse(both, far)
    assert reused.effective_sample_size < 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reuse(both, TARGET)


def test_a_target_elsewhere(both):
    far = BoxUniform(torch.tensor([50.0]), torch.tensor([51.0]))
    with pytest.raises(ValueError, match="got 4000 rows, all of density 0; simulate"):
        reuse(both, far)
    empty = Bank(both.path.parent / "empty", simulator=noisy)
    with pytest.raises(ValueError, match=r"expected rows in .*; got none"):
        reuse(empty, TARGET)
    with empty:
        append(empty, both.read(slice(0, 9)), 0)
        with pytest.raises(ValueError, match="got none whose proposal is known"):
            reuse(empty, TARGET)
