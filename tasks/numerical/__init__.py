"""The paper's numerical model, with exact inference."""

from sbi_active.tasks.numerical.task import NumericalTask

__all__ = ["NumericalTask"]
