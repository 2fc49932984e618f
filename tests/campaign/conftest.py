from functools import partial

import pytest

from sbi_active.design import designer
from sbi_active.design.search import GradientSearch


@pytest.fixture(scope="module", autouse=True)
def short_search():
    """Where a campaign's next action comes from matters here, not how good it is."""
    with pytest.MonkeyPatch.context() as patch:
        quick = partial(GradientSearch, num_rounds=1, num_starts=4)
        patch.setattr(designer, "GradientSearch", quick)
        yield
