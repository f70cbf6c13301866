"""Texts that a person may have saved with any editor are read alike, or refused with the cause."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from liex_lab.pipelines.training.action_model import read_any_labels

from liex_lab.actions.labels import read_labels
from liex_lab.body.skeleton import PRESETS, Skeleton
from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.recordings.camera_file import CameraFile
from liex_lab.runtime.text_files import (
    as_it_was,
    clock_s,
    copy_harmless,
    decoded,
    harmless,
    number,
    read_harmless,
    write_csv,
)
from liex_lab.scene.zones import read_zones

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"]


@given(
    text=st.text(st.characters(codec="ascii", exclude_characters="\0"), min_size=8),
    encoding=st.sampled_from(ENCODINGS),
)
def test_a_text_is_the_same_in_every_encoding(text: str, encoding: str) -> None:
    assert decoded(text.encode(encoding)) == text


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"a = 1\nb = 'M\xe4use'\n", "line 2 holds"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "line 1 holds"),
        (b"name = 1\n\0\0\0\0", "line 2 holds"),
    ],
)
def test_what_is_no_text_is_refused_with_its_place(raw: bytes, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        decoded(raw)


STUDY = 'name = "s"\n[[animals]]\nid = "m1"\n'
STUDY += '[[sessions]]\nanimal = "m1"\nsession = "01"\nrecording = "a.mcap"\n'
ZONES = '[[zones]]\nname = "nest"\ncircle = { centre = [0, 0], radius = 5 }\n'
READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "camera.toml": ("[camera]\nfx = 575.8\n", CameraFile.read),
    "study.toml": (STUDY, lambda path: Study.load(path).table),
    "plan.toml": (Plan.load("mouse").to_toml(), Plan.load),
    "zones.toml": (ZONES, read_zones),
    "skeleton.toml": ((PRESETS / "mouse.toml").read_text(), lambda path: Skeleton.load(path).table),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_toml_of_a_windows_editor_says_what_the_plain_one_says(
    tmp_path: Path, name: str, encoding: str
) -> None:
    text, read = READERS[name]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    expected = read(path)
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert read(path) == expected


@pytest.mark.parametrize("name", READERS)
def test_a_toml_with_a_decimal_comma_is_refused_with_its_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("# a comment\nx = 575,8\n")
    with pytest.raises(LiexError, match=r"line 2.*'x = 575,8'"):
        READERS[name][1](path)


def table(rows: list[list[str]], separator: str, comma: bool) -> str:
    """Lines of a table; a cell that holds the separator is quoted."""
    rows = [[cell.replace(".", ",") if comma else cell for cell in row] for row in rows]
    quoted = [[f'"{cell}"' if separator in cell else cell for cell in row] for row in rows]
    return "\r\n".join(separator.join(row) for row in quoted)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("separator", "comma"), [(";", True), (";", False), ("\t", True), (",", False), (",", True)]
)
@pytest.mark.parametrize("head", ["", "sep={}\r\n"])
def test_labels_of_a_spreadsheet_are_read_whatever_separates_its_cells(
    tmp_path: Path, encoding: str, separator: str, comma: bool, head: str
) -> None:
    ours = [["session_id", "action", "start_s", "stop_s"], ["007", "dig", "0.25", "1.5"]]
    ours += [["NA", "rear", "0:00:02.5", "00:01:03"]]
    boris = [["Observation id", "Subject", "Behavior", "Start (s)", "Stop (s)"]]
    boris += [["007", "", "dig", "0.25", "1.5"], ["NA", "", "rear", "2.5", "63"]]
    for rows in (ours, boris):
        text = head.format(separator) + table(rows, separator, comma)
        path = tmp_path / "labels.csv"
        path.write_bytes(text.encode(encoding))
        found = read_any_labels(path)
        assert found["session_id"].tolist() == ["007", "NA"]
        assert found["start_s"].tolist() == [0.25, 2.5]
        assert found["stop_s"].tolist() == [1.5, 63.0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("action,start_s,stop_s\ndig,0,5,1,5\n", "line 2 has 5 cells"),
        ("action;start_s;stop_s\ndig;900;950\nrear;1,034;1,050\n", "separators of thousands"),
        ("action;start_s;stop_s\ndig;1.034,5;1.050,5\n", "separators of thousands"),
        ("action,start_s,stop_s\nM\xe4h,1,2\n", "line 2 holds"),
    ],
)
def test_labels_whose_numbers_are_not_certain_are_refused(
    tmp_path: Path, text: str, says: str
) -> None:
    path = tmp_path / "labels.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(LiexError, match=says):
        read_labels(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_table_of_animals_may_come_from_a_spreadsheet(
    tmp_path: Path, encoding: str, separator: str
) -> None:
    from liex_lab.pipelines.compare import _overruled

    rows = [["subject_id", "group", "note"], ["007", "drug", "0.5"], ["NA", "", "1"]]
    path = tmp_path / "animals.csv"
    path.write_bytes(table(rows, separator, separator == ";").encode(encoding))
    told = _overruled(pd.DataFrame({"subject_id": ["NA", "007"]}), path)
    assert told["group"].tolist() == ["", "drug"]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("0:00:01", 1), ("01:02:03.25", 3723.25), ("100:00:00,5", 360_000.5), ("02:03.5", 123.5)],
)
def test_times_of_day_are_seconds(text: str, seconds: float) -> None:
    assert float(clock_s(text)) == seconds


@pytest.mark.parametrize("text", ["01:02", "1:60:00", "1:00:60", "1,000,000", "1.000,5", "nan", ""])
def test_what_is_neither_number_nor_time_is_refused(text: str) -> None:
    for read in (clock_s, number):
        with pytest.raises(ValueError, match="is no"):
            read(text)


# No cell or heading of a CSV file is a formula, and what is read back is what was written.


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
