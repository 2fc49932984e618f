"""Attacks on campaigns: bad measurements, odd priors, actions and settings."""

from __future__ import annotations

from benchmarks.robustness.attacks import Attacks

ATTACKS = Attacks()
