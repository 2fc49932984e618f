"""A robot's parameters from its recordings, in one call."""

from __future__ import annotations

from collections.abc import Sequence

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.identification import IdentifiedBelief
from sbi_active.criticism.identification import identify as identify_trials
from sbi_active.expected import suggests
from sbi_active.mujoco.effects.library import likely_effects
from sbi_active.mujoco.robot import Robot


@suggests
def identify_robot(
    robot: Robot,
    *,
    trials: Trials | None = None,
    beside: Sequence[Effect] | None = None,
    seed: int = 0,
) -> IdentifiedBelief:
    """Return the belief of recordings over a robot's parameters, with intervals.

    It is :func:`sbi_active.criticism.identification.identify` with what the MJCF may
    lack beside the parameters.

    Args:
        robot: Robot of :func:`.from_mjcf` or :func:`.from_sysid`.
        trials: Trials in place of the robot's recordings.
        beside: Effects that may be there; None takes friction loss, quadratic damping
            and stiffness of each joint, and a lag of each drive.
        seed: Seed of all draws.

    Raises:
        ValueError: If there are no recordings.
    """
    trials = robot.trials if trials is None else trials
    if trials is None:
        raise ValueError(
            "expected a robot with recordings; got none; pass trials=, or "
            "from_mjcf(recordings=...)"
        )
    if beside is None:
        beside = likely_effects(robot, trials)
    return identify_trials(
        robot.simulator, robot.prior, trials, beside=beside, seed=seed
    )
