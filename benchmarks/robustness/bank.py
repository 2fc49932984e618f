"""Attacks on the bank: damaged, crafted and old files, killed writers."""

from __future__ import annotations

from benchmarks.robustness.attacks import Attacks

ATTACKS = Attacks()
