"""No cell or heading of a CSV file is a formula, and what is read back is what was written."""

from __future__ import annotations

import csv
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.runtime.text_files import as_it_was, copy_harmless, harmless, read_harmless, write_csv

FORMULAS = [
    "=1+1",
    "+1",
    "-1+1",
    "@SUM(1+1)",
    " =1",
    "\t=1",
    "\r=1",
    "\n=1",
    "'=1",
    "=cmd|' /C calc'!A0",
    "a;=cmd|calc!A0",
    "a; =cmd|calc!A0",
    'a";=cmd|calc!A0',
    "a\n=cmd|calc!A0",
    "\uff1d1",
]


def opened(text: str, separator: str) -> list[str]:
    """Cells as a spreadsheet that splits at a separator takes them, quoted or not."""
    strict = [cell for row in csv.reader(text.splitlines(), delimiter=separator) for cell in row]
    loose = [cell for line in text.splitlines() for cell in line.split(separator)]
    return [cell.strip(' "') for cell in strict + loose]


@pytest.mark.parametrize("text", FORMULAS)
def test_no_cell_or_heading_is_a_formula_whatever_separates_cells(
    text: str, tmp_path: Path
) -> None:
    table = pd.DataFrame({"session_id": ["a"], "group": [text], f"{text}_count": [-3.5]})
    path = tmp_path / "a.csv"
    write_csv(table, path)
    raw = path.read_bytes().decode()
    for separator in ",;\t":
        for cell in opened(raw, separator):
            assert cell == "-3.5" or cell[:1] not in tuple("=+-@\uff1d"), (separator, cell)
    again = read_harmless(path, ("session_id",))
    if "\r" not in text:  # pandas takes it for a line end
        assert list(again.columns) == list(table.columns)
        assert again.loc[0, "group"] == text


@given(st.text(st.sampled_from("=+-@'; \t\r\nax\uff1d")))
def test_what_was_made_harmless_comes_back(text: str) -> None:
    assert as_it_was(harmless(text)) == text


@pytest.mark.parametrize("text", ["", "mouse", "a - b", "centre;north", "a;b", "50 %", "x=1", 3.5])
def test_plain_cells_stay_as_they_are(text: object) -> None:
    assert harmless(text) == text


def test_headings_of_several_rows_are_made_harmless(tmp_path: Path) -> None:
    columns = pd.MultiIndex.from_product(
        [["liex_lab"], ["=nose", "rump"], ["x"]], names=list("abc")
    )
    write_csv(pd.DataFrame([[1.0, 2.0]], columns=columns), tmp_path / "a.csv", index=True)
    assert (tmp_path / "a.csv").read_text().splitlines()[1] == "b,'=nose,rump"


def test_a_copy_of_a_foreign_file_is_harmless_and_keeps_its_numbers(tmp_path: Path) -> None:
    source = tmp_path / "a.csv"
    source.write_text("session_id,=x,d\n=cmd|calc!A0,-1.50,1e-3\n'=kept,+2,\n")
    copy_harmless(source, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == (
        "session_id,'=x,d\n'=cmd|calc!A0,-1.50,1e-3\n'=kept,+2,\n"
    )


@pytest.mark.parametrize("name", ["", "NA", "nan", "None", "007", "1e3", "-1"])
def test_a_name_is_text_whatever_it_looks_like(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_csv(pd.DataFrame({"session_id": [name], "distance_m": [1.5]}), path)
    again = read_harmless(path, ("session_id",))
    assert again["session_id"].tolist() == [name]
    assert again["distance_m"].tolist() == [1.5]
