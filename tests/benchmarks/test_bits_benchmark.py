"""The comparison to the last bit sees a last bit."""

import json

import torch

from benchmarks.bits.run import FIGURES, figures, runs


def test_a_last_bit_counts():
    x = torch.tensor([1.0, 2.0])
    other = torch.nextafter(x, torch.tensor([2.0, 2.0]))
    assert figures([x]) == figures([x.clone()])
    for different in ([other], [x.double()], [x, None], [x[None]]):
        assert figures(different)["digest"] != figures([x])["digest"]


def test_every_run_is_written_down():
    assert list(json.loads(FIGURES.read_text())["runs"]) == [name for name, _ in runs()]
