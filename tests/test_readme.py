"""The snippets of the README and the docs run as printed, a page in one namespace."""

import re
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]


def run(page: Path) -> dict:
    namespace: dict = {}
    for snippet in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(compile(snippet, str(page), "exec"), namespace)
    return namespace


@pytest.mark.filterwarnings("ignore")
def test_readme(capsys):
    namespace = run(ROOT / "README.md")
    printed = capsys.readouterr().out
    assert "Design(action [3], EIG" in printed
    assert "theta[theta_1]" in printed
    assert len(namespace["campaign"].history) == 3
    assert namespace["report"].verdict == "bias"
    assert "Verdict: bias (P" in printed
    assert "P holds among the\ndeclared effects alone" in printed


@pytest.mark.filterwarnings("ignore")
def test_simulations(capsys):
    namespace = run(ROOT / "docs" / "simulations.md")
    printed = capsys.readouterr().out
    assert "tensor([0.1274, 0.5097, 1.1468])" in printed
    assert "{'ok': 3, 'invalid': 0, 'missing': 0}" in printed
    # A quarter of the prior's rows lie in the narrower box, all with the same weight.
    assert 80 < namespace["reused"].effective_sample_size < 170


@pytest.mark.filterwarnings("ignore")
def test_closing_the_loop(capsys):
    namespace = run(ROOT / "docs" / "closing_the_loop.md")
    printed = capsys.readouterr().out
    assert printed.startswith("unexplained\nVerdict: drag (P ")
    table = namespace["report"].before_after.set_index("metric")
    # Four numbers with a noise of 5 mm: the standard error of their RMSE is 1.8 mm.
    assert table.loc["rmse", "after"] < 0.005 + 4 * 0.0018
    assert table.loc["rmse", "ratio"] < 0.5
    assert namespace["page"].exists()
    assert printed.splitlines()[-2:] == ["alarm", "('drag',)"]
    truth = torch.tensor([0.4, 0.3])
    belief = namespace["campaign"].belief
    assert ((belief.mean - truth).abs() < 4 * belief.variance.sqrt()).all()
