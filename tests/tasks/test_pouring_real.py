import numpy as np
import pytest
import torch

from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("pybullet")
from sbi_active.tasks.pouring import intersection_volume  # noqa: E402
from sbi_active.tasks.pouring.real import COMPARED_AT, DENSITIES  # noqa: E402

LOW = torch.tensor([15.0, 0.0, 1.6])


@pytest.fixture(scope="module", params=["beads", "gravel"])
def task(request):
    return get_task("pouring_real", material=request.param, cubes=8)


def test_is_the_paper_s(task):
    assert task.num_rounds == 4
    assert len(task.actions.values) == 27
    values = task.actions.values
    assert [sorted(set(values[:, k].tolist())) for k in range(3)] == [
        [15.0, 35.0, 55.0],
        [-30.0, 0.0, 30.0],
        pytest.approx([0.2, 0.9, 1.6]),
    ]
    compared = torch.tensor(COMPARED_AT)
    assert bool(torch.isclose(values, compared).all(1).any())
    assert task.parameter_names == [
        "ground_friction",
        "ground_dynamic_friction",
        "ground_restitution",
        "friction",
        "rolling_friction",
        "restitution",
        "linear_damping",
        "angular_damping",
    ]
    assert task.pours.particles.density == DENSITIES[task.material]
    assert len(task.real_pours.particles) == len(task.pours.particles) == 8
    assert task.theta_true.isnan().all()


def test_materials_are_not_the_model():
    beads = get_task("pouring_real", material="beads").real_pours.particles
    gravel = get_task("pouring_real", material="gravel").real_pours.particles
    model = get_task("pouring_real").pours.particles
    assert (beads.shape, gravel.shape, model.shape) == ("cylinder", "box", "box")
    assert np.ptp(model.half, axis=0).max() == 0
    assert 0.04 < np.log(beads.half[:, 0]).std() < 0.12
    assert 0.004 <= 2 * gravel.half.min() < 2 * gravel.half.max() <= 0.012
    # About as much material as the model has.
    volume = 8 * model.half.prod(1).sum()
    assert volume / 2 < 8 * gravel.half.prod(1).sum() < 1.2 * volume
    assert volume / 2 < 2 * np.pi * beads.half.prod(1).sum() < 1.2 * volume


def test_a_pour_of_the_material_follows_its_seed(task):
    x = task.real_system(LOW, seed=3)
    assert x.shape == (22_500,)
    assert torch.equal(task.real_system(LOW, seed=3), x)
    assert not torch.equal(task.real_system(LOW, seed=4), x)


def test_all_eight_parameters_change_where_cubes_lie():
    task = get_task("pouring_real", cubes=6)
    base = torch.full((9, 8), 0.4)
    base[1:] += 0.5 * torch.eye(8)
    # Static friction acts where some still move and most rest: in a slow pour.
    slow = torch.tensor([15.0, 0.0, 0.2])
    static = task.pours.poses(base[:2], slow.expand(2, 3), torch.tensor([0, 0]))
    assert np.abs(static[1] - static[0]).max() > 1e-4
    others = base[[0, *range(2, 9)]]
    seeds = torch.zeros(8, dtype=torch.int64)
    poses = task.pours.poses(others, LOW.expand(8, 3), seeds)
    for changed in poses[1:]:
        assert np.abs(changed - poses[0]).max() > 1e-4


def test_dampings_are_parameters_and_no_effects(task):
    names = [effect.name for effect in task.effects()]
    assert "tilt" in names
    assert not [name for name in names if "damping" in name]


def test_intersection_volume_is_what_two_heaps_share():
    real = torch.zeros(22_500)
    real[:10] = 4.0
    simulated = torch.zeros(2, 22_500)
    simulated[0, 5:15] = 6.0
    assert intersection_volume(real, simulated).tolist() == [20.0, 0.0]
    assert float(intersection_volume(real, real[None])) == 40.0


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"material": "sand"}, "expected material among 'beads', 'gravel'; got 'sand'"),
        ({"size": 0.0}, "expected size > 0; got 0.0"),
        ({"size": 20.0}, "expected particles that fit a bucket"),
        ({"cubes": 0}, "expected 1 to 1000 particles; got 0"),
    ],
)
def test_bad_options(options, text):
    with pytest.raises(ValueError, match=text):
        get_task("pouring_real", **options)


def test_there_is_no_truth_to_choose():
    with pytest.raises(ValueError, match="expected a material; got a truth"):
        get_task("pouring_real", cubes=8).with_truth([0.5] * 8)
