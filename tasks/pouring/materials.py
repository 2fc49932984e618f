"""What is poured, on what and in which surroundings; and the engine itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from types import ModuleType

import numpy as np

__all__ = [
    "BUCKET_SIDE",
    "CUBE",
    "EFFECT_NAMES",
    "MOST_PARTICLES",
    "NOTHING_ELSE",
    "Particles",
    "Surface",
    "Surroundings",
    "cubes",
    "load_pybullet",
]

CUBE = (0.002, 0.002, 0.0025)  # m, half sides: 4 x 4 x 5 mm
BUCKET_SIDE = 0.10  # m, inside
MASS_SCALE = 1e3  # only ratios of masses matter
MOST_PARTICLES = 1000
PITCH = 1.24  # of the lattice that particles start on, in heights of the largest


@dataclass(frozen=True)
class Surface:
    """What the ground is made of.

    Attributes:
        friction: While particles rest or creep.
        restitution: Of a bounce.
        dynamic_friction: While they move; None is as at rest.
    """

    friction: float = 0.8
    restitution: float = 0.8
    dynamic_friction: float | None = None


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    r"""What a real pour may have and the model leaves out; the defaults are the model.

    Attributes:
        linear_damping: Share of a particle's velocity that is lost in a second.
        angular_damping: Of its angular velocity.
        tilt: Of the ground about x, degrees; downhill toward +y is positive.
        bucket_y: Error of the bucket's position, m.
        bucket_height: Error of its height, m.
        cohesion: Rolling friction beyond theta's, in its units.
        lag: Of the rotation behind the commanded rate, s, of first order.
    """

    linear_damping: float = 0.0
    angular_damping: float = 0.0
    tilt: float = 0.0
    bucket_y: float = 0.0
    bucket_height: float = 0.0
    cohesion: float = 0.0
    lag: float = 0.0


NOTHING_ELSE = Surroundings()
EFFECT_NAMES = tuple(field.name for field in fields(Surroundings))


@dataclass(frozen=True)
class Particles:
    """What is poured.

    Attributes:
        half: Half sides of each, m, shape (n, 3).
        shape: "box", or "cylinder" of radius half[:, 0] and height 2 half[:, 2].
        density: kg/m^3.
        spread: Standard deviation of the logarithm of each particle's own friction.
    """

    half: np.ndarray
    shape: str = "box"
    density: float = 1000.0
    spread: float = 0.0

    def __len__(self) -> int:
        return len(self.half)

    @property
    def masses(self) -> np.ndarray:
        """Inside the engine, shape (n,)."""
        filling = 1.0 if self.shape == "box" else math.pi / 4
        return MASS_SCALE * self.density * filling * (2 * self.half).prod(1)

    def lattice(self) -> np.ndarray:
        """Return where they start within the bucket, from its middle, m, (n, 3).

        Raises:
            ValueError: If they do not fit into the bucket.
        """
        tallest = 2 * float(self.half.max())
        pitch = PITCH * tallest
        side = int((BUCKET_SIDE - tallest) / pitch)
        layers = -(-len(self) // side**2) if side else 0
        if not side or layers * pitch > BUCKET_SIDE:
            raise ValueError(
                f"expected particles that fit a bucket of {BUCKET_SIDE * 1e3:g} mm; "
                f"got {len(self)} of up to {tallest * 1e3:g} mm; pour fewer or smaller "
                "ones"
            )
        grid = np.arange(side) - (side - 1) / 2
        squares = np.add.outer(grid**2, grid**2).ravel()
        place = np.argsort(squares, kind="stable")  # from the middle outwards
        layer, within = np.divmod(np.arange(len(self)), side**2)
        column, row = np.divmod(place[within], side)
        middle = (side - 1) / 2
        bottom = -BUCKET_SIDE / 2 + 0.64 * tallest + 0.0008
        return np.stack(
            [(column - middle) * pitch, (row - middle) * pitch, bottom + layer * pitch],
            -1,
        )


def cubes(num: int, *, density: float = 1000.0, size: float = 1.0) -> Particles:
    """Return cubes of a size, 1 for the paper's 4 x 4 x 5 mm."""
    return Particles(size * np.tile(CUBE, (num, 1)), density=density)


def load_pybullet() -> ModuleType:
    """Return PyBullet.

    Raises:
        ImportError: If it is not installed; the text says how to.
    """
    try:
        import pybullet
    except ImportError as error:
        raise ImportError(
            "expected PyBullet for the pouring; got no package 'pybullet'; run "
            "pip install 'sbi-active[pybullet]'"
        ) from error
    return pybullet
