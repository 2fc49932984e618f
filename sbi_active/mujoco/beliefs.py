"""Beliefs of robots: from recordings, and for the tools of MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.identification import IdentifiedBelief, identify
from sbi_active.expected import require, suggests
from sbi_active.mujoco.effects.library import likely_effects
from sbi_active.mujoco.robot import Robot
from sbi_active.seeding import draws_of

NUM_DRAWS = 10_000


@suggests
def identify_robot(
    robot: Robot,
    *,
    beside: Sequence[Effect] | None = None,
    seed: int = 0,
) -> IdentifiedBelief:
    """Return the belief of recordings over a robot's parameters, with intervals.

    It is :func:`sbi_active.criticism.identification.identify` with what the MJCF may
    lack beside the parameters.

    Args:
        robot: Robot of :func:`.from_mjcf` or :func:`.from_sysid`.
        beside: Effects that may be there; None takes friction loss, quadratic damping
            and stiffness of each joint, and a lag of each drive.
        seed: Seed of all draws.

    Raises:
        ValueError: If there are no recordings.
    """
    if robot.trials is None:
        raise ValueError(
            "expected a robot with recordings; got none; pass from_mjcf(recordings=...)"
        )
    beside = likely_effects(robot) if beside is None else beside
    parts = robot.simulator, robot.prior, robot.trials
    return identify(*parts, beside=beside, seed=seed)


def belief_to_parameters(
    belief: Any,
    params: Any = None,
    *,
    names: Sequence[str] | None = None,
    level: float = 0.95,
    seed: int = 0,
    path: str | Path | None = None,
) -> Any:
    """Return a ``ParameterDict`` of ``mujoco.sysid`` that says what a belief says.

    Each parameter has the belief's mean as its value and nominal, and its central
    interval as bounds; frozen ones stay as they are. ``ParameterDict.load_from_disk``
    reads the file, in the order of the parameters, which ``save_to_disk`` would sort.

    Args:
        belief: Belief over the free parameters in the order of
            ``params.as_vector()``, with ``sample``.
        params: The ``ParameterDict`` that the belief began with, whose shapes, frozen
            parameters and modifiers are kept; None makes one of single numbers.
        names: Names of the parameters where there are no ``params``; None takes those
            of the belief.
        level: Probability of the intervals.
        seed: Seed of the draws.
        path: Path of a YAML file to write.

    Raises:
        ValueError: If their number of parameters differs, or there are no names.
        ImportError: If ``mujoco.sysid`` is not installed.
    """
    try:
        from mujoco.sysid import Parameter, ParameterDict  # pyright: ignore
    except ImportError as error:
        raise ImportError(
            "expected mujoco.sysid; got none; run pip install 'sbi-active[sysid]'"
        ) from error
    draws = _draws(belief, seed)
    mean = draws.mean(0)
    low, high = np.quantile(draws, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    if params is None:
        each = zip(_names(belief, names, len(mean)), mean, low, high, strict=True)
        params = ParameterDict({n: Parameter(n, *numbers) for n, *numbers in each})
    advice = "pass the parameters that it began with"
    expected = f"a belief over {params.size} free parameters"
    require(params.size == len(mean), expected, len(mean), advice)
    found, at = params.copy(), 0
    for own in found.values():
        if own.frozen:
            continue
        here = slice(at, at + own.size)
        at += own.size
        own.value, own.min_value, own.max_value = (
            part[here].reshape(own.shape) for part in (mean, low, high)
        )
        own.nominal = own.value.copy()
    if path is not None:
        import yaml

        states = {name: own.__getstate__() for name, own in found.items()}
        Path(path).write_text(yaml.safe_dump(states, sort_keys=False))
    return found


class Randomization(NamedTuple):
    """Ranges and joint draws for domain randomization.

    Attributes:
        names: Names of the parameters.
        ranges: Ranges by level, {name: (low, high)}, central intervals of single
            parameters.
        samples: Joint draws, shape (n, d), which keep what ranges lose: the
            correlations between parameters.
    """

    names: tuple[str, ...]
    ranges: dict[float, dict[str, tuple[float, float]]]
    samples: Array


def randomization(
    belief: Any,
    levels: Sequence[float] = (0.5, 0.9, 0.99),
    *,
    names: Sequence[str] | None = None,
    num_samples: int = 1_000,
    seed: int = 0,
) -> Randomization:
    """Return a randomization of a simulation, as wide as a belief is.

    Args:
        belief: Belief with ``sample``; a prior's box will do.
        levels: Probabilities of the ranges, each in (0, 1).
        names: Names of the parameters; None takes those of the belief.
        num_samples: Joint draws to return.
        seed: Seed of the draws.

    Raises:
        ValueError: If a level is no probability, or there are no names.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> box = BoxUniform(torch.zeros(2), torch.ones(2))
        >>> found = randomization(box, levels=[0.9], names=["mass", "damping"])
        >>> low, high = found.ranges[0.9]["mass"]
        >>> round(high - low, 1), found.samples.shape
        (0.9, (1000, 2))
    """
    are_shares = all(0 < level < 1 for level in levels)
    require(are_shares, "levels between 0 and 1", levels, "pass probabilities")
    draws = _draws(belief, seed)
    known = _names(belief, names, draws.shape[1])
    ranges = {}
    for level in levels:
        ends = np.quantile(draws, [0.5 - level / 2, 0.5 + level / 2], axis=0).T
        each = zip(known, ends.tolist(), strict=True)
        ranges[float(level)] = {name: (low, high) for name, (low, high) in each}
    return Randomization(known, ranges, draws[:num_samples])


def _draws(belief: Any, seed: int) -> Array:
    draws = draws_of(belief, NUM_DRAWS, seed, "randomization")
    return draws.detach().cpu().double().reshape(NUM_DRAWS, -1).numpy()


def _names(belief: Any, names: Sequence[str] | None, num: int) -> tuple[str, ...]:
    for own in ("parameter_names", "names"):
        names = getattr(belief, own, None) if names is None else names
    names = names or ()
    got = [*names] or None
    require(len(names) == num, f"{num} names of parameters", got, "pass names=")
    return tuple(map(str, names))
