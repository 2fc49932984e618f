"""What is known of a belief, as a value."""

import json

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics

KNOWN = Diagnostics(
    trustworthy=True,
    assumptions={"settled": Assumption(False, 0.3)},
    num_simulations=300,
    tail_probability=0.4,
    tail_probability_of_trial=(0.4, 0.6),
    error_nats=0.02,
).extended(bandwidth=0.1, num_missing=2)


def test_as_plain_data():
    plain = KNOWN.to_dict()
    assert json.loads(json.dumps(plain)) == plain
    assert plain["assumptions"] == {"settled": {"holds": False, "figure": 0.3}}
    assert plain["bandwidth"] == 0.1
    assert "effective_sample_size" not in plain  # not known
