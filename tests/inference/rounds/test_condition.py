import pytest
import torch

from sbi_active.inference import ActionEmbedding
from sbi_active.inference.rounds.condition import (
    action_rows,
    outcome_rows,
    pack,
    unpack,
)


def test_unpack_undoes_pack():
    x, action = torch.rand(5, 2, 3), torch.rand(5, 2)
    condition = pack(x, action)
    assert condition.shape == (5, 8)
    back = unpack(condition, (2, 3))
    assert torch.equal(back[0], x)
    assert torch.equal(back[1], action)


def test_one_action_serves_all_rows():
    assert action_rows(torch.tensor([1.0, 2.0]), 2, num_rows=3).shape == (3, 2)
    assert action_rows(torch.tensor(1.0), 1).shape == (1, 1)


@pytest.mark.parametrize("action", [torch.rand(3), torch.rand(5, 2), torch.rand(2, 3)])
def test_wrong_action(action):
    with pytest.raises(ValueError, match=r"expected action of shape \(4, 2\)"):
        action_rows(action, 2, num_rows=4)


def test_outcomes_keep_their_shape():
    assert outcome_rows(torch.rand(2, 3), (2, 3)).shape == (1, 2, 3)
    assert outcome_rows(torch.rand(4, 2, 3), (2, 3)).shape == (4, 2, 3)
    assert outcome_rows(torch.tensor(1.0), (1,)).shape == (1, 1)
    with pytest.raises(ValueError, match="expected x of shape"):
        outcome_rows(torch.rand(3, 2), (2, 3))


def test_embedding_sees_x_in_its_own_shape():
    seen = []

    class Net(torch.nn.Module):
        def forward(self, x):
            seen.append(x.shape)
            return x.flatten(1).sum(1, keepdim=True)

    embedding = ActionEmbedding(Net(), x_shape=(1, 4, 4), action_dim=2)
    out = embedding(torch.ones(3, 18))
    assert seen == [(3, 1, 4, 4)]
    assert out.tolist() == [[16.0, 1.0, 1.0]] * 3
    with pytest.raises(ValueError, match="expected a packed condition of 18 numbers"):
        embedding(torch.ones(3, 17))
