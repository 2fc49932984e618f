"""Seeds: everything random takes one, and nothing here seeds the process.

A row of simulations has a seed of its own, made from (seed, index), so that an outcome
depends neither on the number of workers nor on the size of a batch. Random numbers of
a row come from a counter (SplitMix64), which NumPy and torch cannot do for many keys
at once. Code that only knows the global generators of torch and NumPy runs under
:func:`forked_generators`, which restores them.

Calls that take a seed, or need none, leave both global generators as they were and do
not depend on them: campaigns, designs, refinements, updates with a seed, simulators and
their noise, reports, exports. Three kinds of calls draw from torch's, as anywhere in
torch and sbi: sampling that takes no seed (``belief.sample``, as of any distribution,
and ``model(theta, action)`` without ``seeds``), a call whose ``seed=`` is left at None,
and what is sbi's own to the last bit: making a trainer (sbi draws from the prior to
look at it), ``train``, and sampling an sbi posterior.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from scipy.special import ndtri
from torch import Tensor

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: SplitMix64


def derive_seed(seed: int, *key: int | str) -> int:
    """Return a seed for one purpose, independent of those for other keys.

    Args:
        seed: The user's seed, a non-negative integer.
        key: Purpose of the seed, for example ``("train", 3)``.

    Returns:
        An integer in [0, 2**63).

    Example:
        >>> derive_seed(0, "train", 1) == derive_seed(0, "train", 1)
        True
        >>> derive_seed(0, "train", 1) == derive_seed(0, "train", 2)
        False
    """
    if seed < 0:
        raise ValueError(f"expected a seed >= 0; got {seed}; use 0, 1, 2, ...")
    words = [k if isinstance(k, int) else zlib.crc32(k.encode()) for k in key]
    state = np.random.SeedSequence([seed, *words]).generate_state(1, np.uint64)
    return int(state[0] >> np.uint64(1))


@contextmanager
def forked_generators(seed: int | None, *key: int | str) -> Iterator[None]:
    """Seed torch's and NumPy's global generators inside the block, restore them after.

    Args:
        seed: The user's seed; None leaves the generators as they are.
        key: Purpose of the seed, as in :func:`derive_seed`.
    """
    if seed is None:
        yield
        return
    derived = derive_seed(seed, *key) if key else seed
    with kept_generators():
        # torch.manual_seed would queue a call, with a stack trace, for every device
        # that is not initialized yet.
        torch.default_generator.manual_seed(derived)
        if torch.cuda.is_initialized():
            torch.cuda.manual_seed_all(derived)
        np.random.seed(derived % 2**32)
        yield


@contextmanager
def kept_generators() -> Iterator[None]:
    """Restore torch's and NumPy's global generators after the block."""
    numpy_state = np.random.get_state()
    with torch.random.fork_rng(enabled=True, devices=_devices()):
        try:
            yield
        finally:
            np.random.set_state(numpy_state)


def draws_of(distribution: Any, num: int, seed: int, *key: int | str) -> Tensor:
    """Return draws of a seed of their own, (num, d), for moments and tables.

    Args:
        distribution: Belief, which knows draws for these, or any distribution.
        num: Number of draws.
        seed: The user's seed.
        key: Purpose of the seed, as in :func:`derive_seed`.
    """
    if (quick := getattr(distribution, "quick_sample", None)) is not None:
        return quick(num, seed=derive_seed(seed, *key) if key else seed)
    with forked_generators(seed, *key):
        return distribution.sample(torch.Size([num]))


def _devices() -> list[int]:
    initialized = torch.cuda.is_initialized()
    return list(range(torch.cuda.device_count())) if initialized else []


def row_seeds(seed: int, num_rows: int, *, first: int = 0) -> Tensor:
    """Return one seed a row, a function of (seed, index) alone.

    Args:
        seed: The seed of the whole set of simulations.
        num_rows: Number of rows n.
        first: Index of the first row.

    Returns:
        Shape (n,), int64, non-negative.
    """
    base = np.uint64(derive_seed(seed, "rows"))
    with np.errstate(over="ignore"):
        index = np.arange(first, first + num_rows, dtype=np.uint64)
        seeds = _mix(base + _GOLDEN * (index + np.uint64(1)))
    return torch.from_numpy((seeds >> np.uint64(1)).astype(np.int64))


def row_uniforms(seeds: Tensor, num: int, *, first: int = 0) -> Tensor:
    """Return uniform numbers within (0, 1), row i a function of ``seeds[i]`` alone.

    Args:
        seeds: Seeds, shape (n,), int64.
        num: Numbers a row.
        first: Place of the first of them in the row's stream.

    Returns:
        Shape (n, num), float64.
    """
    key = seeds.cpu().numpy().astype(np.uint64)[:, None]
    with np.errstate(over="ignore"):
        counter = _GOLDEN * np.arange(first + 1, first + num + 1, dtype=np.uint64)
        bits = _mix(_mix(key) + counter)
    # 53 random bits, centred in their cells: never 0 or 1, where ndtri is infinite.
    return torch.from_numpy(((bits >> np.uint64(11)).astype(np.float64) + 0.5) / 2**53)


def row_normals(seeds: Tensor, num: int) -> Tensor:
    """Return standard normal numbers, the quantiles of :func:`row_uniforms`.

    Args:
        seeds: Seeds, shape (n,), int64.
        num: Numbers a row.

    Returns:
        Shape (n, num), float64.
    """
    return torch.from_numpy(ndtri(row_uniforms(seeds, num).numpy()))


def _mix(z: np.ndarray) -> np.ndarray:
    """Return the SplitMix64 finalizer (Steele, Lea & Flood, OOPSLA 2014)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
