"""A kept row outlives a change of code only where both versions learn the same to the last bit."""

from __future__ import annotations

import copy
import json
import sys
from importlib.util import find_spec
from typing import Any

import pytest
from liex_lab.pipelines.evaluation.paper import (
    cached_results,
    quick,
    same_code,
    small_models,
    table_text,
)
from liex_lab.pipelines.evaluation.paper.fingerprints import learning_code
from liex_lab.pipelines.evaluation.paper.published import TITLES
from liex_lab.pipelines.evaluation.paper.results import SAME_AS, Results
from liex_lab.pipelines.evaluation.paper.rows import ROWS

from liex_lab.catalog import kept_results_folder
from liex_lab.errors import LiexError

THEN = {"rf": {"code": "old", "learned": "x"}, "paper": {"code": "older", "learned": "y"}}
NOW = {"rf": {"code": "new", "learned": "x"}, "paper": {"code": "newer", "learned": "y"}}


def row(code: str, **more: Any) -> dict[str, Any]:
    return {"made": {"learning_code": code, "seeds": [0], **more}, "splits": {"hard": 3.0}}


def test_a_row_is_taken_over_where_both_versions_learn_the_same():
    kept = {"rf": row("old"), "paper": row("older", same_as=["oldest"])}
    before = copy.deepcopy(kept)
    entries, told = same_code.taken_over(kept, THEN, NOW)
    assert kept == before
    assert entries["rf"] == row("new", same_as=["old"])
    assert entries["paper"] == row("newer", same_as=["oldest", "older"])
    assert told == [
        f"{name}: taken over, for today's code learns the same to the last bit" for name in kept
    ]


@pytest.mark.parametrize(
    ("code", "then", "now", "why"),
    [
        ("old", THEN, {"rf": {"code": "new", "learned": "z"}}, "learns something else"),
        ("another", THEN, NOW, "not of the code it was set against"),
        ("old", {}, NOW, "could not be trained here"),
        ("old", THEN, {}, "could not be trained here"),
        ("new", {"rf": {"code": "old", "learned": "z"}}, NOW, "of today's code already"),
    ],
)
def test_any_other_row_is_left_as_it_is(code, then, now, why):
    entries, told = same_code.taken_over({"rf": row(code)}, then, now)
    assert entries == {"rf": row(code)}
    assert len(told) == 1
    assert why in told[0]


def test_the_file_keeps_everything_but_the_codes(tmp_path, monkeypatch):
    source = kept_results_folder() / "mouse.json"
    (tmp_path / source.name).write_bytes(source.read_bytes())
    kept = json.loads(source.read_text(encoding="utf-8"))
    codes = {name: one["made"]["learning_code"] for name, one in kept["rows"].items()}
    codes |= {name: one["made"]["learning_code"] for name, one in kept["sensitivity"].items()}
    versions = {
        python: {
            name: {"code": code if python == "before" else f"{code[:8]}changed", "learned": "x"}
            for name, code in codes.items()
        }
        for python in ("before", sys.executable)
    }
    monkeypatch.setattr(same_code, "learned_with", lambda python, animal: versions[python])
    told = same_code.take_over("before", ["mouse"], tmp_path)
    assert len(told) == len(kept["rows"]) + len(kept["sensitivity"])
    assert all("taken over" in one for one in told)
    after = json.loads((tmp_path / source.name).read_text(encoding="utf-8"))
    for part in ("rows", "sensitivity"):
        for entry in after[part].values():
            made = entry["made"]
            before = made[SAME_AS].pop()
            assert made["learning_code"] == f"{before[:8]}changed"
            made["learning_code"] = before
            if not made[SAME_AS]:
                del made[SAME_AS]
    assert after == kept
    assert cached_results.kept_results("mouse", tmp_path)["rows"].keys() == kept["rows"].keys()


def test_the_tables_say_which_row_is_of_earlier_code():
    results = Results("mouse", ["nose"], ["hard"])
    results.rows = {"rf": row("new", same_as=["first", "old"]), "paper": row("newer")}
    told = table_text.words(results, quick=True)
    assert told == [
        f"{TITLES['rf']} was measured with earlier code (first, old), which learns from 2,048 "
        "pictures the same as today's to the last bit."
    ]


def test_every_row_learns_something_of_its_own(monkeypatch):
    monkeypatch.setattr(small_models, "_N_IMAGES", 256)
    monkeypatch.setattr(small_models, "_N_AFTERWARDS", 256)
    monkeypatch.setattr(quick, "_N_BASELINE", 256)
    with_cnn = find_spec("torch") is not None
    rows = [name for name in ROWS if name != "cnn" or with_cnn]
    told = small_models.learned("mouse")
    assert list(told) == rows
    assert {name: one["code"] for name, one in told.items()} == {
        name: learning_code(name) for name in rows
    }
    assert len({one["learned"] for one in told.values()}) == len(rows)


def test_a_version_that_cannot_train_is_named_in_a_sentence(tmp_path):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'Traceback' >&2; echo 'No module named x' >&2; exit 1\n")
    python.chmod(0o755)
    with pytest.raises(LiexError, match=r"python should train small models of mouse.*No module"):
        same_code.learned_with(str(python), "mouse")


@pytest.mark.parametrize("words", [[], ["python", "rat"], ["/nowhere/python", "mouse"]])
def test_a_word_that_makes_no_sense_is_refused_and_nothing_is_written(words):
    before = {path: path.read_bytes() for path in kept_results_folder().glob("*.json")}
    with pytest.raises(LiexError, match=r"^(expected the interpreter|/nowhere/python should be)"):
        same_code.main(words)
    assert {path: path.read_bytes() for path in kept_results_folder().glob("*.json")} == before
