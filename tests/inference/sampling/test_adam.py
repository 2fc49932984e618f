import copy

import pytest
import torch

from sbi_active.inference.sampling.adam import Adam


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_it_is_that_of_torch_to_the_last_bit(fused, decay):
    ours = torch.nn.Sequential(torch.nn.Linear(5, 3), torch.nn.Linear(4, 2))
    theirs = copy.deepcopy(ours)
    kind = torch.optim.AdamW if decay else torch.optim.Adam
    known = kind(theirs.parameters(), lr=0.01, weight_decay=decay, fused=fused or None)
    steps = Adam(ours.parameters(), rate=0.01, decay=decay, fused=fused)
    for _ in range(20):
        x = torch.randn(7, 5)
        for made, optimizer in ((ours, steps), (theirs, known)):
            for parameter in made.parameters():
                parameter.grad = None
            made[0](x).square().mean().backward()  # the second layer has no gradient
            optimizer.step()
    for one, two in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(one, two)
