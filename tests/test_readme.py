"""The README's snippets run as printed, in order, in one namespace."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


def test_there_are_snippets():
    assert len(SNIPPETS) == 3
    assert "campaign.tell(x)" in SNIPPETS[0]


@pytest.mark.filterwarnings("ignore")
def test_snippets_run_and_print(capsys):
    namespace: dict = {}
    for snippet in SNIPPETS:
        exec(compile(snippet, str(README), "exec"), namespace)
    printed = capsys.readouterr().out
    assert "Design(action [3], EIG" in printed
    assert "theta[theta_1]" in printed
    assert len(namespace["campaign"].history) == 3
