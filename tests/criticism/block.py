"""A block that slides to rest, after which its simulator lacks drag or a gain."""

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.criticism import Effect
from tests.effects import half, normal, with_error

SENSOR = 0.005
SPEEDS = torch.tensor([1.0, 2.5, 1.5, 3.0, 2.0, 0.75, 2.75, 1.25, 2.25, 1.75])
ROLE = ["fit"] * 6 + ["held out"] * 4
GAIN = Effect.keyword("gain", prior=normal(0.2))
DRAG = Effect.keyword("drag", prior=half())


def friction(low: float, high: float = 1.0) -> BoxUniform:
    """Return a prior of the friction, which is .4."""
    return BoxUniform(torch.tensor([low]), torch.tensor([high]))


def stop(theta, action, *, gain=0.0, drag=0.0):
    """Return the way to rest; a gain is as good as friction; none beyond 9 m/s."""
    if (theta <= 0).any():
        raise ValueError("expected positive friction")
    speed = action * (1 + torch.as_tensor(gain)[..., None])
    drag = torch.as_tensor(drag)[..., None].clamp(min=1e-6)
    way = torch.log1p(drag * speed**2 / (9.81 * theta)) / (2 * drag)
    return way.where(action <= 9, torch.nan)


def slid(drag: float = 0.0, fn=stop) -> Tensor:
    """Return what is measured of ten trials, with a drag."""
    x = fn(torch.full((10, 1), 0.4), SPEEDS[:, None], drag=torch.full((10,), drag))
    return with_error(x, SENSOR)
