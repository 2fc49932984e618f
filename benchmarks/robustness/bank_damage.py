"""Random damage of a bank's file: bits that are flipped, ends that are cut off."""

from __future__ import annotations

import random

import torch

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.bank_files import FILE, filled, refused, same_or_refused
from sbi_active import Bank

ATTACKS = Attacks()


@ATTACKS.add("bits are flipped", cases=range(8), seconds=600)
def flipped(case: int) -> None:
    folder = filled(seeds=(0, 1))
    expected = Bank(folder).read()
    path = folder / FILE
    content = path.read_bytes()
    for place in range(case, len(content), 64):
        damaged = bytearray(content)
        damaged[place] ^= 1 << random.Random(place).randrange(8)
        path.write_bytes(damaged)
        same_or_refused(folder, expected)


@ATTACKS.add("files are cut", cases=range(4), seconds=600)
def cut(case: int) -> None:
    folder = filled(seeds=(0, 1))
    expected = Bank(folder).read()
    path = folder / FILE
    content = path.read_bytes()
    for length in range(case, len(content) - 1, 64):
        path.write_bytes(content[:length])
        refused(lambda: Bank(folder).read(), folder)
    path.write_bytes(content)
    assert torch.equal(Bank(folder).read().x, expected.x)
