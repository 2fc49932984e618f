"""Attacks on the number of parameters and of numbers in an outcome."""

from __future__ import annotations

from benchmarks.robustness.attacks import Attacks

ATTACKS = Attacks()
