"""Attacks on the closed loop: outliers, aliases, effects and noise declared wrong."""

from __future__ import annotations

from benchmarks.robustness.attacks import Attacks

ATTACKS = Attacks()
