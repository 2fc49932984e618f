import pytest
import torch

from sbi_active.inference import ActionEmbedding


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
