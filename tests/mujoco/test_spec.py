"""A model's source: the same model in every process, and no more than what moves."""

import pickle

import mujoco
import numpy as np
import pytest

from sbi_active.mujoco.models.spec import Source

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
BLOCK = """<mujoco><compiler meshdir="parts"/>
<asset><mesh name="block" file="block.obj"/>
<texture name="wood" type="2d" file="missing.png"/>
<material name="wooden" texture="wood" rgba="1 0 0 1"/></asset>
<worldbody><body><joint name="hinge" axis="0 1 0"/>
<geom type="mesh" mesh="block" material="wooden"/></body></worldbody></mujoco>"""


@pytest.fixture
def path(tmp_path):
    (tmp_path / "parts").mkdir()
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += ["f 1 2 4", "f 1 4 3", "f 5 8 6", "f 5 7 8", "f 1 5 6", "f 1 6 2"]
    lines += ["f 3 4 8", "f 3 8 7", "f 1 3 7", "f 1 7 5", "f 2 6 8", "f 2 8 4"]
    (tmp_path / "parts/block.obj").write_text("\n".join(lines))
    (tmp_path / "block.xml").write_text(BLOCK)
    return tmp_path / "block.xml"


def from_elsewhere(path, monkeypatch):
    monkeypatch.chdir(path.parent)
    return mujoco.MjSpec.from_file("block.xml")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match=r"an MJCF file; got none at .*arm.xml; check"):
        Source(tmp_path / "arm.xml")


@pytest.mark.parametrize("is_spec", [False, True])
def test_other_processes_find_meshes_beside_the_file(path, monkeypatch, is_spec):
    source = Source(from_elsewhere(path, monkeypatch) if is_spec else path)
    monkeypatch.chdir("/")
    here, there = source.compile(), pickle.loads(pickle.dumps(source)).compile()
    assert here.body_mass[1] == pytest.approx(2000.0, rel=1e-6)
    np.testing.assert_array_equal(here.body_inertia, there.body_inertia)
