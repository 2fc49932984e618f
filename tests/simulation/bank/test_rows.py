"""The mask of stored rows, against a set of them."""

import numpy as np

from sbi_active.simulation.bank.rows import StoredIndex


def test_it_knows_what_a_set_knows():
    rng = np.random.default_rng(0)
    stored, index = set(), StoredIndex("run")
    for _ in range(60):
        rows = rng.integers(rng.integers(1, 500), size=rng.integers(0, 40))
        fresh, expected = index.unseen(rows), []
        for k, row in enumerate(rows):
            expected.append(row not in stored and row not in rows[:k])
        np.testing.assert_array_equal(fresh, expected)
        index.add(rows[fresh])
        stored |= {*rows.tolist()}
    assert index.run == "run"
    assert not index.unseen(np.array([*stored])).any()
