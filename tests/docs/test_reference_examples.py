"""Every public name has an example that runs: its docstring's, or one beside it."""

import doctest
import importlib
import inspect
import re

import pytest

from tests.docs import ROOT, extension

#: Names that need an extra, and the attribute of a module that it brings.
SYSID = ("mujoco.sysid", "ModelSequences")
OPTIONAL = {"from_sysid": SYSID, "belief_to_parameters": SYSID}
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
pytest.importorskip("sphinx")

reference = extension("reference")
DEAR = {"pyro": pytest.mark.slow}  # trains a network


@pytest.mark.parametrize(
    "package", [pytest.param(p, marks=DEAR.get(p, ())) for p in reference.PACKAGES]
)
def test_examples_run(package):
    setup, blocks = reference.examples(package)
    names: dict = {}
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    parser = doctest.DocTestParser()
    for name, text in {"setup": setup, **blocks}.items():
        if name in OPTIONAL and not _is_there(*OPTIONAL[name]):
            continue
        case = parser.get_doctest(text, names, f"{package}.{name}", None, 0)
        failed = runner.run(case, clear_globs=False)
        names = case.globs
        assert not failed.failed, f"{package}.{name}"


def _is_there(module: str, attribute: str) -> bool:
    """Return whether a module is installed with what it needs."""
    try:
        return hasattr(importlib.import_module(module), attribute)
    except ImportError:
        return False


@pytest.mark.parametrize("package", reference.PACKAGES)
def test_every_name_has_one(package):
    _, blocks = reference.examples(package)
    without = []
    for module, names in reference.groups(package):
        for name in names:
            text = inspect.getdoc(getattr(importlib.import_module(module), name))
            if ">>>" not in (text or "") or name == "TASKS":
                without.append(name)
    assert sorted(blocks) == sorted(without)
    assert all(">>> " in block for block in blocks.values())


# What benchmarks print becomes tables of the site, from committed rows


page = extension("results")


def test_each_section_shows_its_tables():
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    included = re.findall(r"{include} reference/api/results/(.+)", text)
    titles = [t for t in re.findall("## (.+)", text) if t in page.TABLES]
    assert included == [page.file_of(title).name for title in titles]
    assert {*included} == {page.file_of(title).name for title in page.TABLES}


@pytest.mark.parametrize("title", page.TABLES)
def test_a_section_has_its_tables(title):
    text = page.tables(page.TABLES[title])
    assert text.count("```bash") == len(page.TABLES[title])
