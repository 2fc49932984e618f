"""A driven oscillator: four parameters, two actions, six numbers."""

from sbi_active.tasks.oscillator.task import OscillatorTask

__all__ = ["OscillatorTask"]
