import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring.loop.emulator import (  # noqa: E402
    NUM_NUMBERS,
    SHIFTS,
    VOLUME,
    Emulator,
    interpolation,
    pictures_numbers,
)
from benchmarks.pouring.loop.picture import blocks, standardized  # noqa: E402
from benchmarks.pouring.loop.run import averaged, poured, truth_of  # noqa: E402
from benchmarks.pouring.loop.summary import summarize  # noqa: E402
from benchmarks.pouring.loop.worlds import draw, get_world, poured_effects  # noqa: E402
from sbi_active.criticism import Context  # noqa: E402

NOISE = 0.3


@pytest.fixture(scope="module")
def known():
    """An emulator of numbers that are linear in parameters and effects."""
    world = get_world("cubes")
    rows = [draw(world, "cubes", k) for k in range(9)]
    theta = torch.cat([r.theta for r in rows])
    action = torch.cat([r.action for r in rows])
    effects = {
        name: np.concatenate([r.effects[name] for r in rows])
        for name in rows[0].effects
    }
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(len(effects) + 3, NUM_NUMBERS))
    inputs = np.column_stack([theta.numpy(), *effects.values()])
    x = 10 + inputs @ weight + NOISE * rng.standard_normal((len(inputs), NUM_NUMBERS))
    moved = 0.01 * np.array(SHIFTS)[:, None] * np.ones(NUM_NUMBERS)
    return Emulator.fit(world, theta, action, effects, x[:, None] + moved), weight


def test_numbers_follow_a_picture_that_moves_and_grows():
    image = torch.zeros(150, 150)
    image[70:80, 60:70] = 4.0
    x = pictures_numbers(image.reshape(1, -1), side=4.0)[0]
    moved = torch.zeros(150, 150)
    moved[70:80, 65:75] = 4.0
    there = pictures_numbers(moved.reshape(1, -1), side=4.0)[0]
    assert x[3] == pytest.approx(there[2])  # five pixels on
    # 100 pixels are worth 25 cubes of 4 mm, all of them in the third band.
    assert x[2, 2] == pytest.approx(np.sqrt(25 + 3 / 8))
    assert x[2, 3] == pytest.approx(np.sqrt(3 / 8))
    taller = pictures_numbers(1.1 * image.reshape(1, -1), side=4.0)[0]
    assert taller[2, : VOLUME[0]] == pytest.approx(x[2, : VOLUME[0]])
    ratio = (taller[2] ** 2 - 3 / 8) / (x[2] ** 2 - 3 / 8).clip(1e-9)
    assert ratio[list(VOLUME)] == pytest.approx([1.1, 1.1**2])


def test_what_is_flat_tells_a_box_from_a_dome():
    x, y = np.meshgrid(np.arange(150), np.arange(150), indexing="ij")
    away = np.hypot(x - 70, y - 75) * 2.0  # mm
    dome = np.sqrt(np.maximum(14.0**2 - away**2, 0))
    box = np.where((abs(x - 70) < 9) & (abs(y - 75) < 9), 14.0, 0)
    images = torch.from_numpy(np.stack([dome, box])).reshape(2, -1).float()
    numbers = pictures_numbers(images, side=2.0)[:, SHIFTS.index(0)] ** 2 - 3 / 8
    covered = numbers[:, :6].sum(1)
    flat, gentle = (
        numbers[:, VOLUME[0] - 2] / covered,
        numbers[:, VOLUME[0] - 1] / covered,
    )
    assert flat[0] < 0.05 < 0.7 < flat[1]
    assert flat[0] < gentle[0] < 0.3


def test_an_outcome_is_the_mean_of_the_pours_of_an_action():
    action = torch.tensor([[20.0, 0, 2]] * 4 + [[140.0, 0, 2]] * 4)
    x = torch.arange(16.0).reshape(8, 2)
    trials = averaged(action, x, ["fit", "fit", "held out", "held out"] * 2)
    assert len(trials) == 4
    fitted = trials.x[torch.tensor([r == "fit" for r in trials.role])]
    assert fitted.tolist() == [[1.0, 2.0], [9.0, 10.0]]


def test_offsets_between_shifts_are_interpolated():
    at = interpolation(np.array([0.0, 0.01, -0.02, 0.5]))
    assert at[0] == pytest.approx([0, 0, 1, 0, 0])
    assert at[1] == pytest.approx([0, 0, 0, 1, 0])
    assert at[2] == pytest.approx([1, 0, 0, 0, 0])
    assert at[3] == pytest.approx([0, 0, 0, 0, 1])  # no further than was looked at
    square = np.array(SHIFTS, float) ** 2
    assert interpolation(np.array([0.007]))[0] @ square == pytest.approx(3.5**2)


def test_the_emulator_knows_what_it_learned(known):
    emulator, weight = known
    action = emulator.world.actions[[1, 1, 1]]
    theta = torch.full((3, 3), 0.4)
    phi = np.array([0.0, 1.0, 0.0])
    x = emulator(theta, action, tilt=phi, camera_offset=np.array([0, 0, 0.01])).numpy()
    root = emulator.widened[1] * emulator.roots[1]
    place = 3 + [*emulator.scales].index("tilt")
    assert root @ (x[1] - x[0]) == pytest.approx(weight[place], abs=0.25)
    assert root @ (x[2] - x[0]) == pytest.approx(np.full(NUM_NUMBERS, 0.05), abs=1e-6)
    # What is left of a pour is of about unit size.
    assert 0.8 < np.sqrt((root**2).sum(1).mean()) / NOISE < 2


def test_all_effects_vanish_at_their_nulls_and_move_the_numbers(known):
    emulator, _ = known
    model, theta = emulator.model(), torch.full((1, 3), 0.4)
    action = emulator.world.actions[:1]
    bare = emulator(theta, action)
    names = [effect.name for effect in emulator.effects()]
    assert names == [effect.name for effect in emulator.world.task.effects()]
    for effect in emulator.effects():
        for strength, moves in ((0.0, False), (float(effect.sample(1).abs()), True)):
            phi = torch.full((1, 1), strength)
            keywords = effect.apply({}, phi, action, Context(torch.zeros(1)))
            moved = (emulator(theta, action, **keywords) - bare).abs().max()
            assert (float(moved) > 1e-6) is moves, effect.name
    assert model.noise is not None


def test_rows_have_effects_in_about_half(known):
    world = known[0].world
    rows = draw(world, "cubes", 3)
    assert set(rows.effects) == {e.apply.names[0] for e in poured_effects(world)}
    absent = np.mean([value == 0 for value in rows.effects.values()])
    assert 0.35 < absent < 0.65
    assert min(rows.effects["lag"].min(), rows.effects["cohesion"].min()) >= 0


def test_hidden_effects_are_as_strong_as_said():
    world = get_world("cubes")
    names = [truth_of(world, "hidden", case)[1] for case in range(10)]
    assert set(names) == {effect.name for effect in world.task.effects()}
    for case in range(9):
        _, name, phi = truth_of(world, "hidden", case)
        effect = next(e for e in world.task.effects() if e.name == name)
        size = abs(phi) / float(effect.declared_draws().square().mean().sqrt())
        assert 1 <= size <= 2.5
    assert truth_of(world, "clean", 0)[1:] == ("none", 0.0)


def test_residuals_over_the_picture_are_in_units_of_the_chaos():
    rng = np.random.default_rng(0)
    real, simulated = rng.normal(size=(3, 30, 30)), rng.normal(size=(40, 30, 30))
    assert standardized(real, simulated).std() == pytest.approx(1, abs=0.08)
    image = torch.zeros(150, 150)
    image[5:10, :5] = 2.0
    assert blocks(image.reshape(1, -1))[0, 1, 0] == 2.0
    assert blocks(image.reshape(1, -1)).sum() == 2.0


def test_a_hidden_effect_is_poured_or_seen(known):
    world = known[0].world
    theta, seed = torch.full((3,), 0.5), torch.tensor([1])
    action = world.actions[:1]
    bare = poured(world, theta, action, seed, {})
    grown = poured(world, theta, action, seed, {"camera gain": 0.1})
    assert torch.allclose(grown, 1.1 * bare)
    assert not torch.equal(poured(world, theta, action, seed, {"tilt": 2.0}), bare)


def test_the_summary_counts():
    row = {
        **dict.fromkeys(("log_bayes", "p_truth", "rmse_before", "cpu_seconds"), "2"),
        "rmse_after": "1",
        "case": "0",
    }
    rows = [
        {**row, "kind": "hidden", "truth": "tilt", "phi": "1", "verdict": "tilt"}
        | {"alarm": "True", "place": "1"},
        {**row, "kind": "clean", "truth": "none", "phi": "0", "verdict": "none"}
        | {"alarm": "False", "place": "0"},
        {**row, "kind": "material", "truth": "beads", "phi": ""}
        | {"verdict": "unexplained", "alarm": "True", "place": "0"},
    ]
    text = summarize(rows)
    assert "clean sets: 0 false alarms of 1" in text
    assert "hidden sets: 1 of 1 alarms" in text
    assert "first in 1 of these" in " ".join(text.split())
    assert "median 0.50" in text
    assert "'unexplained' in 1" in text
