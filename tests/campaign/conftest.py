import pytest

from sbi_active.design.search import GradientSearch


@pytest.fixture(scope="module", autouse=True)
def short_search():
    """Where a campaign's next action comes from matters here, not how good it is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GradientSearch, "num_rounds", 1)
        patch.setattr(GradientSearch, "num_starts", 4)
        yield
