"""One command runs every benchmark, and README's table is what rows say."""

import re
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks import table as readme
from benchmarks.__main__ import HERE, benchmarks, main, module_of, parser_of
from benchmarks.rows import benchmark, read

ROOT = Path(__file__).parents[2]


def test_cases_are_run_once_and_those_that_are_asked_for_are_told(tmp_path, capsys):
    made = []

    def row(kind, seed):
        made.append((kind, seed))
        if seed == 3:
            raise ValueError("no")
        return {"value": 10.0 * seed, **({"extra": 1} if kind == "b" else {})}

    run = benchmark(
        tmp_path / "rows.csv",
        row,
        lambda rows: " ".join(f"{r['kind']}{r['seed']}" for r in rows),
        skip=lambda kind, seed: (kind, seed) == ("b", 2),
        may_fail=True,
        kind=("a", "b"),
        seed=range(1, 3),
    )
    parse = parser_of(run, "some").parse_args
    run(**vars(parse(["--summary"])))
    assert not made
    run(**vars(parse([])))
    assert made == [("a", 1), ("b", 1), ("a", 2)]  # ranges vary slowest
    capsys.readouterr()
    run(**vars(parse(["--seeds", "2", "4", "--kind", "a"])))
    assert made[3:] == [("a", 3)]
    assert capsys.readouterr().out.splitlines()[-1] == "a2 a3"
    rows = read(tmp_path / "rows.csv")
    assert [*rows[0]] == ["kind", "seed", "value", "extra", "failure"]
    assert rows[-1]["failure"] == "ValueError: no"
    assert (rows[1]["value"], rows[1]["extra"], rows[0]["extra"]) == ("10", "1", "")


@pytest.mark.parametrize("name", benchmarks())
def test_every_benchmark_has_a_parser_and_describes_its_options(name):
    try:
        run = import_module(module_of(name)).main
    except ImportError as error:
        pytest.skip(str(error))
    parser = parser_of(run, name)
    assert all(action.help for action in parser._actions)


def test_all_are_listed(capsys):
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert {"oracles", "measured.go2", "table"} <= {*benchmarks()}
    for name, line in benchmarks().items():
        assert re.search(rf"^{re.escape(name)} +{re.escape(line)}$", printed, re.M)
        assert line, name


@pytest.mark.parametrize("words", [["search", "--wrong"], ["search", "--seeds", "a"]])
def test_a_wrong_option_ends_the_run(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "usage: python -m benchmarks search" in capsys.readouterr().err
    assert main(["serach"]) == 2


def test_every_command_that_is_written_down_names_a_benchmark():
    files = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *HERE.rglob("*.py")]
    for path in files:
        if "_build" in path.parts or "api" in path.parts:
            continue
        text = path.read_text(encoding="utf-8")
        for name in re.findall(r"python -m\s+benchmarks ([a-z][\w.]*)", text):
            assert module_of(name), path
        for script in re.findall(r"python benchmarks/(\S+\.py)", text):
            assert "__main__" in (HERE / script).read_text(), (path, script)


# README's table is what committed rows say, and holds what is stated of it


README = Path(__file__).parents[2] / "README.md"


def test_readme_shows_the_rows_and_no_value_is_missed():
    lines, misses = readme.table()
    assert "\n" + "\n".join(lines) + "\n\n" in README.read_text()
    assert not misses


@pytest.mark.parametrize("way", ["least = { ratio = 1e3 }", "most = { ratio = 1 }"])
def test_a_missed_value_is_said_and_is_a_failure(tmp_path, monkeypatch, capsys, way):
    stated = tmp_path / "stated.toml"
    row = ("figures", "training"), ("what", "training"), ("result", "{ratio:.0f}")
    lines = [f'{key} = "{value}"' for key, value in (*row, ("beside", ""))]
    stated.write_text("\n".join(["[[row]]", *lines, way]))
    monkeypatch.setattr(readme.table, "__defaults__", (stated,))
    assert main(["table", "readme"]) == 1
    printed = capsys.readouterr()
    assert printed.out.endswith("| training | 43 | |\n")
    assert "training: expected ratio at" in printed.err
