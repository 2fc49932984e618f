"""Noise that is not Gaussian: when it is seen, and that it is a density."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.regression.residuals import (
    NoiseShape,
    ShapeSettings,
)

NUM = 800
TRIAL = np.array([0, 0, 1, 1])
SLOPE = np.array([[4.0, 3.0, 5.0, 4.0], [1.0, 0.5, 1.5, 1.0]])


def drawn(kind: str, num: int, seed: int):
    """Return features, outcomes and their means, which are linear and positive."""
    rng = np.random.default_rng(seed)
    features = np.stack([np.ones(num), rng.uniform(-1, 1, num)], 1)
    mean = features @ SLOPE
    if kind == "gaussian":
        return features, mean + 0.3 * rng.standard_normal(mean.shape), mean
    if kind == "student":
        return features, mean + 0.2 * rng.standard_t(2.5, mean.shape), mean
    return features, mean * rng.gamma(3.0, 1 / 3, mean.shape), mean


def shape_of(kind: str, observed, seed: int = 0) -> NoiseShape | None:
    features, x, _ = drawn(kind, NUM, seed)
    rest = x - observed
    coefficient = np.linalg.lstsq(features, rest, rcond=None)[0]
    residual = rest - features @ coefficient
    return NoiseShape.fit(
        features, coefficient, residual, observed, TRIAL, ShapeSettings()
    )


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["gaussian", "student", "gamma"])
def test_it_is_looked_for_where_it_is(kind: str, seed: int):
    shape = shape_of(kind, np.zeros(4), seed)
    assert (shape is None) == (kind == "gaussian")
    if kind == "student" and shape is not None:
        assert shape.power == pytest.approx(0, abs=0.25)
    if kind == "gamma" and shape is not None:
        assert 0.6 < shape.power < 1.4  # a deviation proportional to the mean


def test_it_integrates_to_one():
    rng, at = np.random.default_rng(0), np.array([[1.0, 0.3]])
    shape = shape_of("gamma", np.zeros(4))
    assert shape is not None
    mean = (at @ shape.coefficient)[0]
    wide = 4 * shape.scale * np.abs(mean) ** shape.power
    values = mean + wide * rng.uniform(-1, 1, (40_000, 4))
    total = []
    for x in np.array_split(values, 40):
        size = shape.scale * (mean**2 + shape.floor**2) ** (0.5 * shape.power)
        total.append(np.exp(log_density(shape, (x - mean) / size) - np.log(size).sum()))
    volume = (2 * wide).prod()
    each = np.concatenate(total) * volume
    assert each.mean() == pytest.approx(1, abs=4 * each.std() / len(each) ** 0.5 + 0.02)


def log_density(shape: NoiseShape, e):
    """Return log densities of residuals of unit size, (n, 4), by a shape of power 0."""
    plain = NoiseShape(
        **{
            **vars(shape),
            "power": 0.0,
            "scale": np.ones(4),
            "coefficient": np.eye(4),
            "observed": np.zeros(4),
        }
    )
    return plain.log_likelihood(-e, np.ones(len(e)))
