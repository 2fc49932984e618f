"""Coupled masses and springs: 4 to 20 parameters, clamped and shaken."""

from sbi_active.tasks.chain.task import ChainTask

__all__ = ["ChainTask"]
