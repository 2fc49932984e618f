"""Tables as text and Markdown, from rows and from data frames."""

import pandas as pd
import torch

from sbi_active.display import Table

TABLE = Table(("model", "P"), [("bare", 0.25), ("drag|lift", "0.7")])


def test_a_table_stands_in_columns():
    head, rule, *rows = TABLE.text().splitlines()
    assert {*rule} == {"-", " "}
    edges = [i + 1 for i, a in enumerate(rule) if rule[i + 1 : i + 2] in ("", " ")]
    assert edges[-1] == len(rule)
    for line, cells in zip([head, *rows], [TABLE.header, *TABLE.rows], strict=True):
        assert line.split() == [*map(str, cells)]
        assert line.startswith(str(cells[0]))
        assert len(line) == len(rule)


def test_a_table_of_markdown_has_as_many_cells_as_headings():
    lines = TABLE.markdown().splitlines()
    assert [line.replace("\\|", "").count("|") for line in lines] == [3] * 4
    assert "drag\\|lift" in lines[-1]


def test_a_data_frame_is_shown_without_what_is_not_known():
    frame = pd.DataFrame(
        {"trial": [0, 1], "gain": [0.123456, float("nan")], "none": [float("nan")] * 2}
    )
    table = Table.of(frame)
    assert table.header == ["trial", "gain"]
    assert table.rows == [["0", "0.1235"], ["1", ""]]


def test_parameters_have_mean_deviation_and_interval():
    draws = torch.linspace(0.0, 1.0, 101)[:, None]
    ((name, mean, sd, interval),) = Table.of_parameters(["mass"], draws).rows
    assert (name, float(mean), float(sd)) == ("mass", 0.5, 0.29)
    assert interval == "0.05 to 0.95"
