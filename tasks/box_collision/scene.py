r"""Two cubes on a table in MuJoCo: the scene, and one run of it.

A pusher of 10 cm slides at a given speed into a resting cube of 15 cm. Frictions are
those of the pairs in contact, the mean of the two surfaces',

.. math::
    \mu_{\text{cube, table}} = \tfrac12 (\theta_{tf} + \theta_{cf}), \quad
    \mu_{\text{pusher, table}} = \tfrac12 (\theta_{tf} + \mu_p), \quad
    \mu_{\text{pusher, cube}} = \tfrac12 (\theta_{cf} + \mu_p), \quad \mu_p = 0.5,

as MuJoCo's own rule, the larger of two, hides the smaller one altogether.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np

__all__ = [
    "DT",
    "FRAMES",
    "FRAME_SECONDS",
    "LocalScene",
    "Scene",
    "Surroundings",
    "load_mujoco",
    "no_renderer",
    "scene_xml",
]

DT = 0.0025  # s; at 0.005 s the fastest pusher passes through the cube
STEPS_PER_FRAME = 4
FRAMES = 100
FRAME_SECONDS = DT * STEPS_PER_FRAME

CUBE_HALF = 0.075  # m
PUSHER_HALF = 0.05
GAP = 0.2  # between the pusher's front and the cube
EDGE = 1.0  # m along x, ahead of the cube and behind it
HALF_WIDTH = 0.6  # m of the table, along y
FLOOR = -1.0  # m
GRAVITY = 9.81
CUBE_KG = 1000.0 * (2 * CUBE_HALF) ** 3  # at a density of 1000 kg/m^3
TIME_CONSTANT = 0.02  # s, of every contact
PUSHER_FRICTION = 0.5

STEPS_PER_LOOK = 20  # between two looks at whether the cube leaves the table
STEPS_PER_REST = 40  # between two looks at whether nothing moves
REST = 1e-2  # m/s and rad/s, below which a body counts as resting
GROWTH = 1e-3  # m/s between two looks, above which it is being set in motion
FALLEN = -0.2  # m, from where the pusher cannot touch the cube again
CLEAR = 0.14  # m beyond the edge, from where the cube cannot touch the table again
HALF_DIAGONAL = CUBE_HALF * math.sqrt(3)
SPARE = 1.0  # m/s, of vertical speed that a tumbling cube may gain on its way
SMALLEST_DENSITY = 1e-3  # of 1000 kg/m^3
SMALLEST_FRICTION = 1e-5  # MuJoCo's own limit
SMALLEST_DAMPING = 0.05  # of an impact, over the critical


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    r"""What a table may have and the model leaves out; the defaults are the model.

    Attributes:
        lost_damping: Of the impact: its damping ratio is 1 less this; 0 to 1.
        viscosity: Of the medium, Pa s.
        air_density: Of the medium, kg/m^3.
        tilt: Of the table about y, degrees; downhill ahead is positive.
        aim: Lateral shift of the pusher's path, m along y.
        center_of_mass: Of the cube, m along y from its middle.
        extra_pusher_friction: Of the pusher's surface, above .5.
        force: On the cube, N along x.
        delay: Of the time stamp, s after the 100th frame.
    """

    lost_damping: float = 0.0
    viscosity: float = 0.0
    air_density: float = 0.0
    tilt: float = 0.0
    aim: float = 0.0
    center_of_mass: float = 0.0
    extra_pusher_friction: float = 0.0
    force: float = 0.0
    delay: float = 0.0


NOTHING_ELSE = Surroundings()


class Scene:
    """A compiled scene that runs one trial after another.

    Every run starts from the same state, so that an outcome depends on neither what ran
    before nor how often. One thread may use it at a time, see :class:`LocalScene`.

    Args:
        offset: Of the cube from the pusher's path, m along y.
        edge: Where the table ends, m along x.
        early_exit: Stop a run when its outcome is settled: the cube leaves the table,
            or nothing can move it any more.

    Raises:
        ImportError: If MuJoCo is not installed.

    Example:
        >>> scene = Scene()
        >>> bool(scene.run([0.8, 0.8, 0.8], 4.0)[0] > 0.05)
        True
    """

    def __init__(
        self, *, offset: float = 0.0, edge: float = EDGE, early_exit: bool = True
    ) -> None:
        self.mujoco = mujoco = load_mujoco()
        self.model = model = mujoco.MjModel.from_xml_string(scene_xml(offset, edge))
        self.data = data = mujoco.MjData(model)
        self.edge, self._exits_early = edge, early_exit
        self.steps = 0  # of the last run
        cube = model.body("cube").id
        # MuJoCo takes the center of mass for the origin of a body whose frames agree.
        model.body_sameframe[cube] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.geom_sameframe[model.geom("cube").id] = (
            mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        )
        # Views into the engine's memory: looking a name up costs more than a step.
        self._masses, self._cube = model.body_mass, cube
        self._inertia = model.body_inertia[cube]
        self._unit_inertia = self._inertia.copy()
        self._offcenter = model.body_ipos[cube]
        friction, index = model.pair_friction, {}
        for name in ("cube table", "pusher table", "pusher cube"):
            index[name] = model.pair(name).id
        # The two tangents of a contact: which is along x depends on the pair.
        self._frictions = [friction[index[name], :2] for name in index]
        self._impact = model.pair_solref[index["pusher cube"]]
        self._gravity = model.opt.gravity
        self._position, self._velocity = data.qpos, data.qvel
        self._force = data.xfrc_applied[cube]

    def prepare(
        self,
        theta: Any,
        speed: float,
        surroundings: Surroundings = NOTHING_ELSE,
    ) -> None:
        """Write parameters and the initial state.

        Args:
            theta: Friction of the table, friction of the cube and density of the cube
                over 1000 kg/m^3, three numbers.
            speed: Of the pusher, m/s.
            surroundings: What else there is.
        """
        table, cube, density = theta
        density = max(density, SMALLEST_DENSITY)
        pusher = max(PUSHER_FRICTION + surroundings.extra_pusher_friction, 0.0)
        pairs = (table + cube, table + pusher, cube + pusher)
        for both, total in zip(self._frictions, pairs, strict=True):
            both[:] = max(0.5 * total, SMALLEST_FRICTION)
        self._masses[self._cube] = CUBE_KG * density
        self._inertia[:] = self._unit_inertia * density
        self._offcenter[1] = surroundings.center_of_mass
        self._impact[1] = max(1.0 - surroundings.lost_damping, SMALLEST_DAMPING)
        options = self.model.opt
        options.viscosity = max(surroundings.viscosity, 0.0)
        options.density = max(surroundings.air_density, 0.0)
        tilt = math.radians(surroundings.tilt)
        self._gravity[0] = GRAVITY * math.sin(tilt)
        self._gravity[2] = -GRAVITY * math.cos(tilt)
        # Without it the contacts keep the inverse weights of another mass, silently.
        self.mujoco.mj_setConst(self.model, self.data)
        self.mujoco.mj_resetData(self.model, self.data)
        self._velocity[0] = speed
        self._position[1] = surroundings.aim
        self._force[0] = surroundings.force
        self._friction = float(self._frictions[0][0])
        pulls = (options.viscosity, options.density, tilt, surroundings.force)
        self._only_rubs = not any(pulls)

    def run(
        self,
        theta: Any,
        speed: float,
        surroundings: Surroundings = NOTHING_ELSE,
    ) -> np.ndarray | None:
        """Return the cube's position when it is observed; None if it left the table.

        Args:
            theta: As in :meth:`prepare`.
            speed: Of the pusher, m/s.
            surroundings: What else there is.

        Returns:
            Position in m, shape (3,), float64.
        """
        self.prepare(theta, speed, surroundings)
        exact = max(FRAMES * STEPS_PER_FRAME + surroundings.delay / DT, 0.0)
        total = math.floor(exact + 1e-9)
        end = self._advance(total)
        if end == "left":
            return None
        position = self._position[7:10].copy()
        if end == "moving":  # part of a step, so that x is smooth in the time stamp
            position += (exact - total) * DT * self._velocity[6:9]
        return position if self._is_on_table(position) else None

    def _advance(self, total: int) -> Literal["left", "resting", "moving"]:
        """Run until the outcome is settled, and return what the cube did."""
        step, model, data = self.mujoco.mj_step, self.model, self.data
        position, velocity, last = self._position, self._velocity, math.inf
        self.steps = 0
        while self.steps < total:
            num = min(STEPS_PER_LOOK, total - self.steps)
            step(model, data, num)
            self.steps += num
            if not self._exits_early:
                continue
            if (
                position[9] < 0
                or self._is_clear(position[7], velocity[6])
                or self._will_leave((total - self.steps) * DT)
            ):
                return "left"
            if self.steps % STEPS_PER_REST:
                continue
            # The pusher comes first in the state; what fell cannot come back.
            moving = velocity[6:] if position[2] < FALLEN else velocity
            fastest = max(moving.max(), -moving.min())
            if fastest < REST and fastest < min(last, REST) + GROWTH:
                return "resting"
            last = fastest
        return "moving"

    def _will_leave(self, seconds: float) -> bool:
        r"""Return whether the cube is too fast for friction to keep it on the table.

        Friction takes at most :math:`\mu` times the table's vertical impulse, which is
        :math:`m (g t + \Delta v_z)` however the cube tumbles:

        .. math::
            \Delta x \ge (u - \mu v)\, t - \tfrac12 \mu g t^2, \qquad
            v = |v_z| + |\omega| r + 1\,\mathrm{m/s},

        with u its speed along x and r half of its diagonal. The pusher, behind it, can
        only add to u, its friction on the cube included.

        Args:
            seconds: Until it is observed.
        """
        if not self._only_rubs:
            return False
        u, _, upward, *spin = self._velocity[6:].tolist()
        gained = abs(upward) + HALF_DIAGONAL * math.hypot(*spin) + SPARE
        slowed = u - self._friction * gained
        if slowed <= 0:
            return False
        deceleration = self._friction * GRAVITY
        t = min(seconds, slowed / deceleration)
        reach = slowed * t - 0.5 * deceleration * t**2
        return bool(self._position[7] + reach > self.edge)

    def _is_clear(self, x: float, velocity: float) -> bool:
        return bool(x > self.edge + CLEAR and velocity > 0 and not self._force[0])

    def _is_on_table(self, position: np.ndarray) -> bool:
        x, y, z = position
        return bool(z >= 0 and abs(x) <= self.edge and abs(y) <= HALF_WIDTH)


class LocalScene(threading.local):
    """A scene a thread, compiled on first use.

    Args:
        offset: As in :class:`Scene`.
        edge: As in :class:`Scene`.
        left_table: What a run gives that ends off the table: NaN, or -1.
    """

    def __init__(
        self, *, offset: float = 0.0, edge: float = EDGE, left_table: float = math.nan
    ) -> None:
        self.scene = Scene(offset=offset, edge=edge)
        self.left_table = left_table


def load_mujoco() -> ModuleType:
    """Return MuJoCo.

    Raises:
        ImportError: If it is not installed; the text says how to.
        RuntimeError: If it cannot load the OpenGL that ``MUJOCO_GL`` names.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            "expected MuJoCo for the box collision; got no package 'mujoco'; run "
            "pip install 'sbi-active[mujoco]'"
        ) from error
    except Exception as error:  # what fails depends on the OpenGL that is missing
        raise RuntimeError(no_renderer(error)) from error
    return mujoco


def no_renderer(error: Exception) -> str:
    """Return what to say where there is no OpenGL to draw with."""
    backend = os.environ.get("MUJOCO_GL", "")
    chosen = f"MUJOCO_GL={backend}" if backend else "MUJOCO_GL not set"
    advice = (
        "do install libegl1 and set MUJOCO_GL=egl, or install libosmesa6 and set "
        "MUJOCO_GL=osmesa (Debian and Ubuntu: apt-get install libegl1 libgl1 "
        "libosmesa6), before Python starts; simulations need neither"
        if sys.platform.startswith("linux")
        else "do draw in a session with a display; simulations need none"
    )
    return (
        "expected an offscreen renderer; got "
        f"{type(error).__name__}: {error} ({chosen}); {advice}"
    )


def scene_xml(offset: float, edge: float) -> str:
    """Return the scene as MJCF."""
    solref = f"{TIME_CONSTANT} 1"
    start = -(CUBE_HALF + GAP + PUSHER_HALF)
    silent = 'contype="0" conaffinity="0"'
    size = " ".join([str(CUBE_HALF)] * 3)
    pusher = " ".join([str(PUSHER_HALF)] * 3)
    return f"""
<mujoco model="box collision">
  <option timestep="{DT}" cone="elliptic" integrator="implicitfast"
    gravity="0 0 {-GRAVITY}"/>
  <worldbody>
    <light pos="0 -1 3" dir="0 0.3 -1"/>
    <geom name="floor" type="plane" size="4 4 1" pos="0 0 {FLOOR}" {silent}
      rgba="0.75 0.75 0.75 1"/>
    <geom name="table" type="box" size="{edge} {HALF_WIDTH} 0.05" pos="0 0 -0.05"
      {silent} rgba="0.6 0.45 0.3 1"/>
    <body name="pusher" simple="false" pos="{start} 0 {PUSHER_HALF}">
      <freejoint/>
      <geom name="pusher" type="box" size="{pusher}" density="1000" {silent}
        rgba="0.8 0.15 0.15 1"/>
    </body>
    <body name="cube" simple="false" pos="0 {offset} {CUBE_HALF}">
      <freejoint/>
      <geom name="cube" type="box" size="{size}" density="1000" {silent}
        rgba="0.15 0.6 0.2 1"/>
    </body>
  </worldbody>
  <contact>
    <pair name="cube table" geom1="table" geom2="cube" condim="3" solref="{solref}"/>
    <pair name="pusher table" geom1="table" geom2="pusher" condim="3"
      solref="{solref}"/>
    <pair name="pusher cube" geom1="pusher" geom2="cube" condim="3" solref="{solref}"/>
  </contact>
</mujoco>
"""
