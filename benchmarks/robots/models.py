"""Small robots, whose MJCFs stand in ``mjcf``."""

from pathlib import Path

import numpy as np

MJCF = Path(__file__).with_name("mjcf")
PENDULUM, SPRING_MASS, ARM = (
    MJCF.joinpath(f"{name}.xml").read_text()
    for name in ("pendulum", "spring_mass", "arm")
)
TIMES = np.arange(1, 16) * 0.1
