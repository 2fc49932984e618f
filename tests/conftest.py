import pytest
import torch


@pytest.fixture(autouse=True)
def _seeded_and_clean(tmp_path, monkeypatch):
    """Each test starts from the same generator and leaves no folder behind."""
    torch.manual_seed(0)
    monkeypatch.chdir(tmp_path)
    yield
    assert not (tmp_path / "sbi-logs").exists()
