"""A kept row of another processor stands where what it was given agrees in numbers, and is said to
be one; of the same processor, or of other code, it does not.
"""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.evaluation.paper import cached_results, exhibits, given, run, table_text
from liex_lab.pipelines.evaluation.paper.common_view import CommonView
from liex_lab.pipelines.evaluation.paper.fingerprints import fingerprint_of
from liex_lab.pipelines.evaluation.paper.further import Further
from liex_lab.pipelines.evaluation.paper.given import Given

MADE = {"recipe": {"n_images": 3, "seed": 5}}
N_FRAMES = 200


def recordings_given(n: int = 4, seed: int = 3) -> Given:
    rng = np.random.default_rng(seed)
    return Given(
        N_FRAMES,
        rng.uniform(300, 900, n),
        rng.uniform(0.01, 0.2, n),
        rng.uniform(0.8, 1.3, n),
        rng.integers(0, 9, n),
        rng.integers(0, 5, n),
    )


def view_of_one(fingerprint: str) -> CommonView:
    none = np.zeros(3, np.bool_)
    return CommonView(1.0, none, none, none, fingerprint)


HASHES: dict[str, Any] = {
    "learning_code": "a",
    "training_pictures": "b",
    "training_given": {"height_mm": 9.5, "covered": 0.21, "joints_mm": 17.25},
    "models": ["c", None],
}
VIEWS = {"clean": [view_of_one("x")]}
TODAY = {"clean": recordings_given()}
OTHERS: dict[str, dict[str, Any]] = {  # each as another processor's last digit would make it
    "training pictures": {"hashes": {"training_pictures": "z"}},
    "test pictures": {"views": {"clean": [view_of_one("z")]}},
}


def kept_row(processor: str) -> dict[str, Any]:
    """A row as it was kept, of a split that was given what is given today."""
    numbers = {
        "fingerprint": fingerprint_of(VIEWS["clean"]),
        "given": TODAY["clean"].to_dict(),
        "median_mm": 3.0,
    }
    made = {"from": MADE, **HASHES, "models": ["c", "d"], "processor": processor}
    return {"made": made, "splits": {"clean": numbers}, "rate": {"frames_per_s": 80.0}}


def why(row: Any, now: Given = TODAY["clean"], **other: Any) -> str:
    hashes = HASHES | other.get("hashes", {})
    views = other.get("views", VIEWS)
    return cached_results.why_refused(row, MADE, hashes, views, {"clean": now})


@pytest.fixture(autouse=True)
def _here(monkeypatch):
    monkeypatch.setattr(given, "processor", lambda: "here")
    monkeypatch.setattr(cached_results, "processor", lambda: "here")


@pytest.mark.parametrize("what", OTHERS)
def test_another_hash_is_refused_of_the_same_processor_and_taken_of_another(what):
    here, elsewhere = kept_row("here"), kept_row("elsewhere")
    assert why(here) == why(elsewhere) == ""
    assert what in why(here, **OTHERS[what])
    assert why(elsewhere, **OTHERS[what]) == ""


@pytest.mark.parametrize("what", OTHERS)
def test_a_row_of_no_known_processor_or_without_numbers_is_refused_where_a_hash_differs(what):
    for part in ("processor", "training_given"):
        row = kept_row("elsewhere")
        del row["made"][part]
        assert why(row) == ""
        assert what in why(row, **OTHERS[what])
    row = kept_row("elsewhere")
    del row["splits"]["clean"]["given"]
    assert "nothing tells in numbers" in why(row, **OTHERS[what])


def test_other_code_and_another_training_are_refused_whatever_the_processor():
    for processor in ("here", "elsewhere"):
        row = kept_row(processor)
        assert "other code" in why(row, hashes={"learning_code": "z"})
        assert "number of models" in why(row, hashes={"models": ["c"]})
        # its numbers are of its own models: see `kept_examples.other_model`
        assert why(row, hashes={"models": ["z", None]}) == ""
        made = {"recipe": {"n_images": 4, "seed": 5}}
        told = cached_results.why_refused(row, made, HASHES, VIEWS, TODAY)
        assert "another training or method" in told


FAR: dict[str, dict[str, Any]] = {
    "the mean depth of recording 2": {"depth_mm": 2 * given.DEPTH_MM},
    "the unread share of recording 2": {"unread": 2 * given.UNREAD},
    "the animal's size of recording 2": {"size": 3 * given.SIZE},
    "the second component is measured": {"second": int(2 * given.FRAMES * N_FRAMES)},
    "another object is measured": {"wrong": int(2 * given.FRAMES * N_FRAMES)},
}


@pytest.mark.parametrize("said", FAR)
@pytest.mark.parametrize("sign", [-1, 1])
def test_what_is_farther_off_than_a_processor_explains_is_refused_and_named(said, sign):
    ((name, off),) = FAR[said].items()
    second_one = np.arange(4) == 1
    then = getattr(TODAY["clean"], name)
    near, far = (
        replace(
            TODAY["clean"], **{name: then + (sign * share * off * second_one).astype(then.dtype)}
        )
        for share in (0.25, 1)
    )
    row = kept_row("elsewhere")
    assert why(row, near, **OTHERS["test pictures"]) == ""
    told = why(row, far, **OTHERS["test pictures"])
    assert said in told
    assert "on clean" in told
    assert "elsewhere" in told
    assert why(row, far) == ""  # the hashes agree to the last digit: nothing else is asked


def test_other_recordings_are_not_near_whatever_they_show():
    fewer = Given.join([recordings_given(3)])
    told = why(kept_row("elsewhere"), fewer, **OTHERS["test pictures"])
    assert f"{N_FRAMES} frames of 4 recordings were given, today {N_FRAMES} frames of 3" in told


@pytest.mark.parametrize(("name", "limit"), [("height_mm", 0.05), ("covered", 1e-3)])
def test_other_training_pictures_are_told_by_their_numbers(name, limit):
    def now(off: float) -> dict[str, Any]:
        known = HASHES["training_given"]
        return {"training_pictures": "z", "training_given": known | {name: known[name] + off}}

    assert why(kept_row("elsewhere"), hashes=now(0.5 * limit)) == ""
    assert "of the training pictures was" in why(kept_row("elsewhere"), hashes=now(2 * limit))


def test_what_a_recording_gives_is_what_a_loop_over_its_pixels_counts():
    rng = np.random.default_rng(5)
    frames = np.where(rng.random((3, 6, 7)) < 0.3, 0, rng.uniform(200, 800, (3, 6, 7)))
    second, wrong = np.array([True, False, True]), np.array([False, False, True])
    found = Given.of(frames.astype(np.float32), CommonView(1.25, second, wrong, wrong, "x"))
    read = [float(one) for one in frames.astype(np.float32).ravel() if one > 0]
    assert found.n_frames == 3
    assert found.depth_mm[0] == pytest.approx(sum(read) / len(read))
    assert found.unread[0] == pytest.approx(1 - len(read) / frames.size)
    assert (found.size[0], found.second[0], found.wrong[0]) == (1.25, 2, 1)
    unread = Given.of(np.zeros((1, 2, 2), np.float32), CommonView(1, wrong[:1], wrong, wrong, "x"))
    assert (unread.depth_mm[0], unread.unread[0]) == (0.0, 1.0)


def test_rounding_takes_less_than_a_fifth_of_what_may_differ():
    exact = recordings_given(40, 11)
    told = Given.from_dict(json.loads(json.dumps(exact.to_dict())))
    assert np.abs(told.depth_mm - exact.depth_mm).max() < given.DEPTH_MM / 5
    assert np.abs(told.unread - exact.unread).max() < given.UNREAD / 5
    assert (np.abs(told.size - exact.size) / exact.size).max() < given.SIZE / 5
    np.testing.assert_array_equal(told.second, exact.second)
    np.testing.assert_array_equal(told.wrong, exact.wrong)
    assert exact.differs(told) == told.differs(exact) == ""


def test_a_row_that_is_taken_by_its_hashes_gets_the_numbers_and_todays_processor():
    old = kept_row("here")
    for part in ("processor", "training_given"):
        del old["made"][part]
    del old["splits"]["clean"]["given"]
    before = copy.deepcopy(old)
    assert cached_results.taken(old, HASHES, VIEWS, TODAY) == kept_row("here")
    assert old == before
    # what a row says of itself stays
    elsewhere = kept_row("elsewhere")
    assert cached_results.taken(elsewhere, HASHES, VIEWS, TODAY) == elsewhere
    other = cached_results.taken(elsewhere, HASHES, OTHERS["test pictures"]["views"], TODAY)
    assert other == {**elsewhere, "other_processor": "elsewhere"}


def test_a_row_of_hands_in_other_postures_is_refused_with_that_reason():
    """Without the labels that they are fitted to, the same command renders other hands."""
    row = kept_row("elsewhere")
    row["made"]["test_postures"] = "fitted to labels"
    other = OTHERS["test pictures"]["views"]
    with_labels = {"test_postures": "fitted to labels"}
    without = {"test_postures": "drawn from statistics"}
    assert why(row, hashes=with_labels, views=other) == ""  # the last digit of another processor
    told = why(row, hashes=without, views=other)
    assert "postures fitted to labels, and those of today are drawn from statistics" in told
    assert "LIEX_NYU" in told
    del row["made"]["test_postures"]  # as rows were kept before
    taken = cached_results.taken(row, HASHES | with_labels, VIEWS, TODAY)
    assert taken["made"]["test_postures"] == "fitted to labels"
    assert "test_postures" not in cached_results.taken(row, HASHES, VIEWS, TODAY)["made"]


def test_rows_that_were_given_alike_keep_it_once_and_read_it_each(tmp_path):
    rows = {name: kept_row("elsewhere") for name in ("default", "paper", "rf")}
    path = cached_results.keep_results(tmp_path, "mouse", rows, {})
    assert path.read_text().count('"depth_mm"') == 1
    told = cached_results.kept_results("mouse", tmp_path)
    assert told["rows"] == {name: rows[name] for name in ("paper", "rf")}
    again = cached_results.keep_results(tmp_path / "again", "mouse", told["rows"], {})
    assert again.read_text() == path.read_text()


def test_a_file_of_before_reads_without_numbers(tmp_path):
    row = kept_row("here")
    del row["splits"]["clean"]["given"]
    content = {"schema": 3, "animal": "mouse", "rows": {"rf": row}, "sensitivity": {}}
    (tmp_path / "mouse.json").write_text(json.dumps(content))
    assert cached_results.kept_results("mouse", tmp_path)["rows"] == {"rf": row}


def test_tables_page_and_json_say_which_row_is_another_processors(tmp_path):
    numbers = {
        "median_mm": 3.0, "mean_mm": 3.1, "interval95": [2.9, 3.1], "mean_interval95": [3.0, 3.2],
        "wrong_object": 0.0, "wrong_object_alone": 0.0, "lost_rate": 0.0, "flip_rate": None,
        "n_frames": 200, "n_recordings": 4,
    }  # fmt: skip
    made = {"from": MADE, "command": "liex", "version": "1", "code": "c", "machine": "m"}
    rate = {"frames_per_s": 9.0, "ratio_to_default": 1.0, "picture": "2 x 2", "cores": 2}
    default, rf = (
        {
            "origin": origin,
            "made": made | {"processor": processor},
            "splits": {"clean": numbers},
            "rate": rate,
        }
        for origin, processor in (("measured", "here"), ("kept", "elsewhere"))
    )
    rf["other_processor"] = "elsewhere"
    results = run.Results("mouse", [], ["clean"], {"default": default, "rf": rf})
    table_text.write_tables(tmp_path, [results], quick=False)
    said = "RF was measured on another processor (elsewhere) than this run's (here)"
    text = (tmp_path / "tables.md").read_text()
    assert text.count(said) == 1
    assert "0.05 mm of mean depth" in text
    assert "| kept, another processor |" in text
    assert "| m, elsewhere |" in text
    flat = json.loads((tmp_path / "tables.json").read_text())["mouse"]["clean"]
    assert {name: one["other_processor"] for name, one in flat.items()} == {
        "default": None,
        "rf": "elsewhere",
    }
    assert json.loads((tmp_path / "results.json").read_text())["mouse"]["rows"]["rf"] == rf
    assert "elsewhere" in (tmp_path / "table1.csv").read_text()
    page = exhibits.exhibits([results], Further(), [], quick=False)
    (table,) = (one for one in page if one["label"] == "Table 1")
    assert said in json.dumps(table, default=str)
    del rf["other_processor"]
    assert not [one for one in table_text.words(results, False) if "another processor" in one]
