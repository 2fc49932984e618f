import sys

import pytest

from sbi_active import InformationGainDesigner
from sbi_active.search import BayesianOptimization
from tests.search.known import SPACE, Counted, objective
from tests.search.test_gradient import loss


@pytest.mark.slow
def test_it_finds_the_highest_of_several_optima():
    pytest.importorskip("botorch")
    evaluate = Counted()
    found = BayesianOptimization(num_rounds=2).finalists(objective(evaluate, num=20))
    assert sum(map(len, evaluate.asked)) <= 20
    assert SPACE.contains(found).all()
    assert loss(found) < 0.1


def test_without_botorch_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "botorch", None)
    with pytest.raises(ImportError, match=r"pip install sbi-active\[botorch\]"):
        InformationGainDesigner(SPACE, search="bayesopt")
