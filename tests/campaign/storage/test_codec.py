"""Objects as data and back: the same numbers, and no code but ours."""

import os
import pickle
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sbi_active import StopRules
from sbi_active.campaign.storage import codec
from sbi_active.campaign.storage.codec import Absent, NotStorableError, decode, encode
from sbi_active.campaign.storage.directory import Storage
from sbi_active.design import Design


def back(value, **known):
    return decode(encode(value, known=known), known=known)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64, bool, complex])
def test_arrays_keep_every_bit(dtype):
    array = (np.random.default_rng(0).normal(size=(3, 0 + 4)) * 3).astype(dtype)
    for value in (array, array.T, array[:, 1], array[0, 0], np.zeros((0, 2), dtype)):
        again = back(value)
        assert again.dtype == value.dtype
        assert again.shape == value.shape
        assert np.array_equal(again, value)
    gap = np.array([np.nan, 1e-300, 1 / 3])
    assert np.array_equal(back(gap), gap, equal_nan=True)


def test_what_is_known_is_referred_to():
    def simulator(theta, action):
        return theta

    assert back([simulator], simulator=simulator)[0] is simulator
    holder = Foreign()
    holder.inner = simulator
    assert back(simulator, holder=holder) is simulator
    within = encode(simulator, known={"holder": holder})
    assert isinstance(decode(within, known={"holder": Absent()}), Absent)
    content = encode([simulator], known={"simulator": simulator})
    absent = Absent()
    assert decode(content, known={"simulator": absent})[0] is absent
    with pytest.raises(NotStorableError, match="function"):
        encode(simulator, known={})


class Foreign:
    pass


def test_only_classes_of_trusted_packages():
    with pytest.raises(NotStorableError, match="Foreign"):
        encode(Foreign(), known={})
    parts = [torch.zeros(1)] * 7
    design = Design(*parts, bound="none", index=0, num_simulations=3)
    assert back(design).num_simulations == 3
    for name in (
        "os:system",
        "subprocess:Popen",
        "sbi_active.cli.__main__:main",
        "sbi_active.__main__.x",  # without a colon each piece would be imported
        "torch.utils.bottleneck.__main__:main",
    ):
        with pytest.raises(ValueError, match="not a type object"):
            decode(written(Called(codec.made, name, {})), known={})
    run = {"sbi_active.__main__", "torch.utils.bottleneck.__main__"}
    assert not run & {*sys.modules}


class Called:
    """What a file may have called while it is read, with whatever arguments."""

    def __init__(self, function, *arguments):
        self.called = function, arguments

    def __reduce__(self):
        return self.called


def written(value):
    buffer = BytesIO()
    module = SimpleNamespace(Pickler=pickle.Pickler, __name__="pickle")
    torch.save(value, buffer, pickle_module=module)
    return zlib.compress(buffer.getvalue())


def test_a_file_has_nothing_else_called(tmp_path):
    place = tmp_path / "made"
    for function, *arguments in (
        (os.mkdir, str(place)),
        (exec, f"import os; os.mkdir({str(place)!r})"),
        (Storage, str(place)),
        (codec.decode, b"", {}),
        (codec.given, "simulator", ""),
        (codec.made, "sbi_active.campaign.options:CampaignOptions", 7),
        (getattr, "a", "join"),
    ):
        with pytest.raises(ValueError, match="expected what this library stores"):
            decode(written(Called(function, *arguments)), known={})
        assert not place.exists()
    with pytest.raises(ValueError, match="expected what this library stores"):
        decode(written(torch.distributions.Normal(0.0, 1.0)), known={})


def test_state_is_set_as_it_is_and_never_by_a_method():
    options = "sbi_active.campaign.options:CampaignOptions"  # whose __setstate__ loads
    bomb = pickle.dumps(Called(os.mkdir, "exploded"))
    state = {"density_estimator": bomb}
    assert decode(written(Called(codec.made, options, state)), known={})
    assert not os.path.exists("exploded")


def test_fields_that_came_later_have_their_defaults():
    kind = "sbi_active.campaign.state:Trial"
    old = Called(codec.made, kind, {"index": 3, "action": None})
    trial = decode(written(old), known={})
    assert (trial.index, trial.status, trial.seconds) == (3, "pending", {})
    options = codec.made("sbi_active.campaign.options:StopRules", {"budget": 2.0})
    assert options == StopRules(budget=2.0)


def test_other_checkpoints_may_call_no_more_than_before():
    with torch.serialization.safe_globals([set]):
        before = {*torch.serialization.get_safe_globals()}
        assert decode(encode({1, 2}, known={}), known={}) == {1, 2}
        assert {*torch.serialization.get_safe_globals()} == before
    assert codec.made not in before


def test_threads_may_read_at_the_same_time():
    content = encode([{k} for k in range(200)], known={})
    with ThreadPoolExecutor(8) as pool:
        found = [*pool.map(lambda _: decode(content, known={}), range(64))]
    assert found == [[{k} for k in range(200)]] * 64
