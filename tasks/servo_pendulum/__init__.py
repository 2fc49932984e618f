"""A servo that swings a pendulum, with recorded trials of a real one."""

from sbi_active.tasks.servo_pendulum.recordings import Recordings, read_recordings
from sbi_active.tasks.servo_pendulum.task import ServoPendulumTask

__all__ = ["Recordings", "ServoPendulumTask", "read_recordings"]
