r"""A bucket of particles poured on the ground in PyBullet: the world, and one run.

A bucket of 10 cm sides stands upright at (0, p, h), turns about its middle at v rad/s
toward +y until it hangs upside down, and what was in it comes to rest on the ground.
Where it does is chaotic: the seed of a run shifts and turns the particles by fractions
of a millimeter before they are poured, and that is all the noise there is.

Lengths and gravity are ten times the real ones inside the engine, which leaves times
and angles as they are and moves its thresholds away from particles of 4 mm. Bullet
multiplies the coefficients of two surfaces, and its rolling friction is a length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from sbi_active.tasks.pouring.materials import (
    BUCKET_SIDE,
    NOTHING_ELSE,
    Particles,
    Surface,
    Surroundings,
    load_pybullet,
)

__all__ = ["DT", "World", "pour"]

SCALE = 10.0  # of lengths and of gravity inside the engine
DT = 1 / 240  # s; at 1/160 s up to a quarter of the particles sink into the ground
SOLVER_ITERATIONS = 10
GRAVITY = 9.81
BUCKET_WALL = 0.005
BUCKET_MASS = 1e7  # so heavy that particles do not push it off its path
BUCKET_SURFACE = 0.5  # friction and restitution
ROLLING_LENGTH = 0.002  # m, at a rolling friction of 1
SPINNING = 0.5  # of the rolling friction

SHIFT = 0.0004  # m, of a particle at the start, for the smallest pitch
TURN = 0.15  # rad, likewise

SETTLING = 0.1  # s, before the bucket turns
PRETILT = 1.4  # rad: what lies behind a wall leaves beyond pi / 2, so until here ...
PRETILT_RATE = 2.0  # rad/s: ... a slow bucket turns at this rate
LAST_ANGLE = 2.6  # rad
STEPS_PER_LOOK = 24
LONGEST_REST = 1.2  # s after the last particle can have reached the ground
SLOW = 0.05  # m/s: one step of gravity is .04, the tremor of what lies still
GROUND = Surface()
FAR = 0.6  # m from the origin, from where no particle comes back into view


class World:
    """A new engine with ground, bucket and particles; use it for one run.

    A world that ran before does not give the same bits again.

    Args:
        particles: What is poured.
        theta: Friction, rolling friction and restitution of a particle, each in [0, 1].
        ground: Its surface.
        around: What else there is.
        seed: Of where the particles start.
        position: Of the bucket's middle, y and z, m.

    Raises:
        ImportError: If PyBullet is not installed.
    """

    def __init__(
        self,
        particles: Particles,
        theta: Sequence[float],
        *,
        ground: Surface,
        around: Surroundings,
        seed: int,
        position: tuple[float, float],
    ) -> None:
        self.engine = p = load_pybullet()
        self.particles, self._ground, self._around = particles, ground, around
        self._y = position[0] + around.bucket_y
        self._z = position[1] + around.bucket_height
        self._starts = particles.lattice()
        self.client = p.connect(p.DIRECT)
        try:
            self._build(theta, np.random.default_rng(seed))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the engine."""
        self.engine.disconnect(self.client)

    def step(self, angle: float, rate: float) -> None:
        """Move on by one time step with the bucket at an angle, turning at a rate."""
        p, own = self.engine, self.client
        turn = [-math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2)]
        # Re-posed at every step, yet with a velocity, which contacts need to know.
        p.resetBasePositionAndOrientation(
            self.bucket, self._place, turn, physicsClientId=own
        )
        p.resetBaseVelocity(
            self.bucket, self._lift, [-rate, 0.0, 0.0], physicsClientId=own
        )
        p.stepSimulation(physicsClientId=own)

    def poses(self) -> np.ndarray:
        """Return positions, m, and quaternions (x, y, z, w), shape (n, 7)."""
        read, own = self.engine.getBasePositionAndOrientation, self.client
        states = [read(body, physicsClientId=own) for body in self.bodies]
        rows = np.array([[*place, *turn] for place, turn in states])
        rows[:, :3] /= SCALE
        return rows

    def speeds(self) -> np.ndarray:
        """Return the particles' speeds, m/s, shape (n,)."""
        read, own = self.engine.getBaseVelocity, self.client
        linear = [read(body, physicsClientId=own)[0] for body in self.bodies]
        return np.linalg.norm(np.array(linear), axis=1) / SCALE

    def set_ground_friction(self, friction: float) -> None:
        """Change what the ground is like from now on."""
        self.engine.changeDynamics(
            self.ground, -1, lateralFriction=friction, physicsClientId=self.client
        )

    def _build(self, theta: Sequence[float], rng: np.random.Generator) -> None:
        p, own = self.engine, {"physicsClientId": self.client}
        slope = math.radians(self._around.tilt)
        down = GRAVITY * SCALE
        p.setGravity(0.0, math.sin(slope) * down, -math.cos(slope) * down, **own)
        p.setPhysicsEngineParameter(
            fixedTimeStep=DT,
            numSubSteps=0,
            numSolverIterations=SOLVER_ITERATIONS,
            contactBreakingThreshold=0.0005 * SCALE,
            restitutionVelocityThreshold=0.02 * SCALE,
            deterministicOverlappingPairs=1,
            enableConeFriction=1,
            **own,
        )
        plane = p.createCollisionShape(p.GEOM_PLANE, **own)
        self.ground = p.createMultiBody(0, plane, useMaximalCoordinates=True, **own)
        self.bucket = self._make_bucket()
        self.bodies = self._make_particles(theta, rng)
        p.changeDynamics(
            self.ground,
            -1,
            lateralFriction=self._ground.friction,
            restitution=self._ground.restitution,
            rollingFriction=0.0,
            **own,
        )
        p.changeDynamics(
            self.bucket,
            -1,
            lateralFriction=BUCKET_SURFACE,
            restitution=BUCKET_SURFACE,
            rollingFriction=0.0,
            **own,
        )

    def _make_bucket(self) -> int:
        """Return an open box; a dynamic body, as a fixed one has no velocity."""
        p, own = self.engine, {"physicsClientId": self.client}
        a, w = BUCKET_SIDE / 2 * SCALE, BUCKET_WALL / 2 * SCALE
        walls = [
            ([a + 2 * w, a + 2 * w, w], [0, 0, -a - w]),
            ([w, a, a], [-a - w, 0, 0]),
            ([w, a, a], [a + w, 0, 0]),
            ([a + 2 * w, w, a], [0, -a - w, 0]),
            ([a + 2 * w, w, a], [0, a + w, 0]),
        ]
        shape = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_BOX] * len(walls),
            halfExtents=[half for half, _ in walls],
            collisionFramePositions=[place for _, place in walls],
            collisionFrameOrientations=[[0, 0, 0, 1]] * len(walls),
            **own,
        )
        self._place = [0.0, self._y * SCALE, self._z * SCALE]
        slope = math.radians(self._around.tilt)
        # What gravity takes within a step, so that the bucket hangs still.
        fall = GRAVITY * SCALE * DT
        self._lift = [0.0, -math.sin(slope) * fall, math.cos(slope) * fall]
        return p.createMultiBody(
            BUCKET_MASS,
            shape,
            basePosition=self._place,
            useMaximalCoordinates=True,
            **own,
        )

    def _make_particles(
        self, theta: Sequence[float], rng: np.random.Generator
    ) -> list[int]:
        p, own = self.engine, {"physicsClientId": self.client}
        particles, around = self.particles, self._around
        num = len(particles)
        starts = self._starts + rng.uniform(-SHIFT, SHIFT, (num, 3))
        starts += [0.0, self._y, self._z]
        turns = rng.uniform(-TURN, TURN, num) / 2
        own_friction = np.exp(particles.spread * rng.standard_normal(num))
        friction, rolling, restitution = theta
        length = (rolling + around.cohesion) * ROLLING_LENGTH * SCALE
        shapes: dict[bytes, int] = {}
        bodies = []
        # One by one: batchPositions makes a single body of these coordinates.
        for i, (half, mass) in enumerate(
            zip(particles.half, particles.masses, strict=True)
        ):
            key = half.tobytes()
            if key not in shapes:
                shapes[key] = self._shape(half * SCALE)
            body = p.createMultiBody(
                mass,
                shapes[key],
                basePosition=(starts[i] * SCALE).tolist(),
                baseOrientation=[0.0, 0.0, math.sin(turns[i]), math.cos(turns[i])],
                useMaximalCoordinates=True,
                **own,
            )
            p.changeDynamics(
                body,
                -1,
                lateralFriction=friction * own_friction[i],
                rollingFriction=length,
                spinningFriction=length * SPINNING,
                restitution=restitution,
                linearDamping=around.linear_damping,
                angularDamping=around.angular_damping,
                **own,
            )
            bodies.append(body)
        return bodies

    def _shape(self, half: np.ndarray) -> int:
        p, own = self.engine, {"physicsClientId": self.client}
        if self.particles.shape == "box":
            return p.createCollisionShape(p.GEOM_BOX, halfExtents=half.tolist(), **own)
        return p.createCollisionShape(
            p.GEOM_CYLINDER, radius=half[0], height=2 * half[2], **own
        )


def pour(
    particles: Particles,
    theta: Sequence[float],
    action: Sequence[float],
    *,
    ground: Surface = GROUND,
    around: Surroundings = NOTHING_ELSE,
    seed: int = 0,
    watch: Callable[[World, float], None] | None = None,
    at_rest: Callable[[World], None] | None = None,
) -> np.ndarray:
    """Pour once, in a new world.

    Args:
        particles: What is poured.
        theta: Friction, rolling friction and restitution.
        action: Height h of the bucket's middle, cm; its y-position p, cm; its angular
            velocity v, rad/s.
        ground: Its surface.
        around: What else there is.
        seed: Of where the particles start.
        watch: Called after each step with the world and the bucket's angle.
        at_rest: Called with the world at the end.

    Returns:
        Positions at rest, m, and quaternions (x, y, z, w), shape (n, 7), float32.
    """
    height, place, rate = float(action[0]) / 100, float(action[1]) / 100, action[2]
    with _world(
        particles,
        theta,
        ground=ground,
        around=around,
        seed=seed,
        position=(place, height),
    ) as world:
        friction = _GroundFriction(world, ground)
        angle = 0.0
        rotation = _rotation(float(rate), around.lag)
        for steps, (angle, speed) in enumerate(rotation, 1):
            world.step(angle, speed)
            if watch is not None:
                watch(world, angle)
            if steps % STEPS_PER_LOOK == 0:
                friction.follow()
                if angle > PRETILT and _is_empty(world, height):
                    break
        longest = math.sqrt(2 * height / GRAVITY) + LONGEST_REST
        for steps in range(1, int(longest / DT) + 1):
            world.step(angle, 0.0)
            if watch is not None:
                watch(world, angle)
            if steps % STEPS_PER_LOOK == 0:
                friction.follow()
                if _rests(world):
                    break
        if at_rest is not None:
            at_rest(world)
        return world.poses().astype(np.float32)


@contextmanager
def _world(*args, **kwargs) -> Iterator[World]:
    world = World(*args, **kwargs)
    try:
        yield world
    finally:
        world.close()


def _rotation(rate: float, lag: float) -> Iterator[tuple[float, float]]:
    """Yield the bucket's angle and its rate, step by step, from before it turns."""
    for _ in range(round(SETTLING / DT)):
        yield 0.0, 0.0
    angle, speed = 0.0, 0.0
    while angle < LAST_ANGLE:
        wanted = max(rate, PRETILT_RATE) if angle < PRETILT else rate
        speed += (wanted - speed) * (min(1.0, DT / lag) if lag > 0 else 1.0)
        angle = min(LAST_ANGLE, angle + speed * DT)
        yield angle, speed


def _is_empty(world: World, height: float) -> bool:
    """Return whether every particle is below the bucket's reach."""
    z = world.poses()[:, 2]
    return bool((z < height - BUCKET_SIDE).all())


def _rests(world: World) -> bool:
    """Return whether every particle that may come into view lies still."""
    poses = world.poses()
    away = np.abs(poses[:, :2]).max(1) > FAR
    return bool((away | (world.speeds() < SLOW)).all())


class _GroundFriction:
    """A ground whose friction differs between particles that slide and that rest."""

    def __init__(self, world: World, ground: Surface) -> None:
        self._world, self._ground = world, ground
        self._moves: bool | None = None
        if ground.dynamic_friction is not None:
            self.follow()

    def follow(self) -> None:
        """Set it by whether most particles near the ground move."""
        if self._ground.dynamic_friction is None:
            return
        low = self._world.poses()[:, 2] < 0.02
        speeds = self._world.speeds()[low]
        moves = not len(speeds) or float(np.median(speeds)) > 0.05
        if moves is not self._moves:
            self._moves = moves
            ground = self._ground
            self._world.set_ground_friction(
                ground.dynamic_friction if moves else ground.friction  # pyright: ignore
            )
