"""Small robots, whose MJCFs stand in ``mjcf``."""

from pathlib import Path

import numpy as np

MJCF = Path(__file__).with_name("mjcf")
PENDULUM, SPRING_MASS, CART_POLE, ARM = (
    MJCF.joinpath(f"{name}.xml").read_text()
    for name in ("pendulum", "spring_mass", "cart_pole", "arm")
)
TIMES = np.arange(1, 16) * 0.1
