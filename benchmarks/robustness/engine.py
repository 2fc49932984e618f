"""Attacks on the engine: hostile simulators, workers that die, interrupted runs."""

from __future__ import annotations

from benchmarks.robustness.attacks import Attacks

ATTACKS = Attacks()
