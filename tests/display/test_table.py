"""Tables as text and Markdown, from rows and from data frames."""

import pandas as pd

from sbi_active.display import Table

TABLE = Table(("model", "P"), [("bare", 0.25), ("drag|lift", "0.7")])


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
