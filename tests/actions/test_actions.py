"""Actions, and signals as actions: what is generated, and what a robot may play."""

import math

import pytest
import torch

from sbi_active import BoxActions, DiscreteActions, MixedActions
from sbi_active.actions import SignalActions
from sbi_active.actions.waveforms import chirp, multisine, recorded, step, together
from sbi_active.criticism import Trials
from sbi_active.design.limits import DesignLimits
from sbi_active.simulation import SimulatorModel

BOX = BoxActions([0.0, -1.0], [2.0, 1.0], names=["speed", "angle"], units=["m/s", ""])
TOOLS = DiscreteActions([0.0, 1.0, 2.0], names=["tool"])
MIXED = MixedActions(BOX, TOOLS)


def test_box_samples_are_uniform_and_seeded():
    draws = BOX.sample((20_000,), seed=0)
    assert draws.shape == (20_000, 2)
    assert torch.equal(draws, BOX.sample((20_000,), seed=0))
    share = (draws - BOX.low) / (BOX.high - BOX.low)
    assert ((share >= 0) & (share <= 1)).all()
    for moment in (1, 2, 3):
        error = (1 / (2 * moment + 1) - 1 / (moment + 1) ** 2) ** 0.5 / 20_000**0.5
        distance = (share**moment).mean(0) - 1 / (moment + 1)
        assert (distance.abs() < 4 * error).all()
    assert BOX.sample((2, 3)).shape == (2, 3, 2)


def test_mixed_samples_are_those_of_independent_parts():
    draws = MIXED.sample((30_000,), seed=1)
    assert torch.equal(draws, MIXED.sample((30_000,), seed=1))
    assert MIXED.contains(draws).all()
    share = torch.bincount(draws[:, 2].long()) / 30_000
    assert ((share - 1 / 3).abs() < 4 * (2 / 9 / 30_000) ** 0.5).all()
    correlation = torch.corrcoef(draws.T)[~torch.eye(3).bool()]
    assert (correlation.abs() < 4 / 30_000**0.5).all()
    two = MixedActions(BoxActions(0.0, 1.0), BoxActions(0.0, 1.0)).sample((9,), seed=0)
    assert not torch.equal(two[:, 0], two[:, 1])  # a seed of its own each


def test_mixed_contains_and_lists():
    some = torch.tensor([[1.0, 0.0, 2.0], [1.0, 0.0, 0.5], [3.0, 0.0, 2.0]])
    assert MIXED.contains(some).tolist() == [True, False, False]
    assert MIXED.listed() is None
    lists = MixedActions(TOOLS, DiscreteActions([[1.0, 2.0], [3.0, 4.0]]))
    assert lists.listed().shape == (6, 3)
    assert lists.listed()[:3].tolist() == [[0, 1, 2], [0, 3, 4], [1, 1, 2]]
    assert lists.contains(lists.listed()).all()


def test_bad_spaces():
    with pytest.raises(ValueError, match="expected actions of shape"):
        DiscreteActions([])
    with pytest.raises(ValueError, match="expected finite low < high"):
        BoxActions(1.0, 1.0)
    with pytest.raises(TypeError, match="expected action spaces; got list"):
        MixedActions([0.0, 1.0])


# Signals as actions: what is generated, and what a robot may play


TIMES = torch.linspace(0, 2, 201)


def chirps(**limits):
    waveform = chirp("voltage", start_frequency=0.5)
    return SignalActions(waveform, [0.5, 1.0], [5.0, 10.0], input_times=TIMES, **limits)


def test_a_chirp_sweeps_its_frequencies():
    space = chirps()
    u = space.inputs(torch.tensor([[2.0, 4.0]]).double())["voltage"][0]
    t = TIMES.double()
    assert torch.allclose(u, 2 * torch.sin(2 * math.pi * (0.5 * t + 3.5 * t**2 / 4)))
    one = space.inputs(torch.tensor([2.0, 4.0]))["voltage"]
    assert one.shape == (201,)


def test_a_multisine_has_low_peaks():
    waveform = multisine([1, 2, 3, 4, 5, 6, 7, 8])
    space = SignalActions(waveform, [0.1] * 8, [1.0] * 8, input_times=TIMES)
    u = space.inputs(torch.ones(1, 8))["input"][0]
    crest = float(u.abs().max() / u[:-1].square().mean().sqrt())
    assert crest < 2.0  # all in phase it is 4
    assert float(u[:-1].square().mean()) == pytest.approx(4.0, rel=1e-3)


def test_only_what_the_robot_can_play_is_permitted():
    fast = torch.tensor([[3.0, 9.0]])  # 3 * 2 pi * 9 = 170 in a second
    assert bool(chirps(rate=175.0).contains(fast))
    assert not bool(chirps(rate=100.0).contains(fast))
    assert not bool(chirps(amplitude=2.0).contains(fast))
    assert not bool(chirps(amplitude={"voltage": (-1.0, 4.0)}).contains(fast))
    space = chirps(rate=100.0, amplitude=4.0)
    drawn = space.sample((5, 40), seed=3)
    assert drawn.shape == (5, 40, 2)
    assert bool(space.contains(drawn).all())
    u = space.inputs(drawn.reshape(-1, 2))["voltage"]
    assert float(u.diff(dim=1).abs().max() / 0.01) <= 100.1
    assert float(u.abs().max()) <= 4.001
    assert torch.equal(drawn, space.sample((5, 40), seed=3))
    assert not bool(space.contains(torch.tensor([9.0, 2.0])))


def test_a_signal_may_last_so_long():
    lasting = {"input_times": TIMES, "duration": (0.2, 0.5)}
    space = SignalActions(step(amplitude=1.0), [0.0, 0.1], [1.0, 1.9], **lasting)
    action = torch.tensor([[0.1, 0.15], [0.1, 0.35], [0.1, 0.6], [0.9, 0.35]])
    assert space.contains(action).tolist() == [False, True, False, True]


def test_a_part_of_a_product_keeps_its_limits():
    space = MixedActions(chirps(rate=100.0), BoxActions(0.0, 1.0, names=["load"]))
    slow, fast = [3.0, 2.0, 0.5], [3.0, 9.0, 0.5]
    both = torch.tensor([slow, fast])
    assert space.permits(both).tolist() == [True, False]
    limits = DesignLimits(space, lambda action: action[:, 0] < 4)
    assert limits(both).tolist() == [True, False]


def test_recorded_signals_are_listed():
    inputs = {"u": torch.tensor([[0.0, 1.0], [0.0, 9.0], [0.0, 2.0]])}
    trials = Trials(None, torch.zeros(3, 2), inputs=inputs, input_times=[0.0, 0.5])
    space = SignalActions(recorded(trials), amplitude=5.0)
    listed = space.listed()
    assert listed.tolist() == [[0.0], [2.0]]
    assert space.names == ["trial"]
    assert space.inputs(torch.tensor([2.0]))["u"].tolist() == [0.0, 2.0]
    assert {*space.sample((50,), seed=0)[:, 0].tolist()} == {0.0, 2.0}
    assert space.contains(torch.tensor([[2.0], [1.0], [1.4]])).tolist() == [1, 0, 0]
    with pytest.raises(ValueError, match="trials 0 to 2; got .7."):
        space.inputs(torch.tensor([[7.0]]))


def test_signals_of_several_inputs_are_one_action():
    both = together(chirp("hip", amplitude=0.2), multisine([1.0, 2.0], "knee"))
    low, high = [0.1, 1.0, 0.0, 0.0], [1.0, 5.0, 0.3, 0.3]
    space = SignalActions(both, low, high, input_times=TIMES, amplitude={"knee": 0.4})
    assert space.names[1:3] == ["hip end frequency", "knee amplitude at 1 Hz"]
    action = torch.tensor([[0.5, 3.0, 0.1, 0.2]])
    played = space.inputs(action)
    alone = chirp("hip", amplitude=0.2)(action[:, :2], TIMES)["hip"]
    assert torch.equal(played["hip"], alone)
    assert [*played] == ["hip", "knee"]
    with pytest.raises(ValueError, match="waveforms of different inputs; got"):
        together(chirp("knee"), step("knee"))


def test_signals_beside_a_category_are_played_by_the_simulator():
    space = MixedActions(chirps(), BoxActions(0.0, 1.0, names=["payload"]))
    action = torch.tensor([[2.0, 4.0, 0.5]])
    alone = chirps().inputs(action[:, :2])["voltage"]
    assert torch.equal(space.inputs(action)["voltage"], alone)
    assert space.input_times.shape == TIMES.shape

    def follow(theta, action, *, inputs, input_times):
        return theta * inputs["voltage"] + action[:, 2:]

    model = SimulatorModel(follow, noise=0.1, inputs=space)
    x = model.mean(torch.ones(1, 1), action)
    assert torch.allclose(x, space.inputs(action)["voltage"] + 0.5)
    with pytest.raises(ValueError, match="one part of signals; got 0 in MixedActions"):
        MixedActions(BoxActions(0.0, 1.0)).inputs(torch.zeros(1, 1))
