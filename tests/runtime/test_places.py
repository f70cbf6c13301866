"""A name that came out of a file is one name in the folder that the user named, or is refused."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.errors import PlaceError
from liex_lab.runtime.durable import (
    inside,
    replacing,
    safe_name,
    storable_document,
    unlinked_below,
    unlinked_tree,
    write_whole,
)
from tests.hostile_names import NAMES


@pytest.mark.parametrize("text", NAMES)
def test_a_hostile_name_is_one_file_right_in_the_folder(text: str, tmp_path: Path) -> None:
    place = inside(tmp_path, text, ".liex")
    place.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == [place.name]
    assert place.resolve().parent == tmp_path.resolve()
    assert len(os.fsencode(place.name)) <= 180
    assert place.name.isprintable()
    assert not place.name.startswith((".", "-"))


@given(st.text(st.characters()), st.sampled_from(["", ".liex", ".analysis.h5"]))
def test_any_text_makes_a_name_that_stays_the_same_when_it_is_made_safe_again(
    text: str, ending: str
) -> None:
    name = safe_name(text, ending)
    assert name == os.path.basename(name) == safe_name(name)
    assert name.endswith(ending)
    name.encode()
    assert not set(name) & set('/\\:*?"<>|\0')


def test_names_that_can_be_names_stay_as_they_are() -> None:
    for text in ("mouse_walk", "2026-08-21 cage 4", "sub-m01_ses-1", "Mäuse 🐁", "a.b", "CONTROL"):
        assert safe_name(text, ".liex") == f"{text}.liex"


def test_a_document_holds_no_half_characters_wherever_they_stood() -> None:
    path = Path(os.fsdecode(b"/data/\xff\xfe.mcap"))
    told = storable_document({"a\udcff": [path, {"b": ("\0", 1.5, None, True)}], "c": "Mäuse 🐁"})
    assert told == {
        "a\ufffd": ["/data/\ufffd\ufffd.mcap", {"b": ["\ufffd", 1.5, None, True]}],
        "c": "Mäuse 🐁",
    }


def test_two_texts_never_share_a_name() -> None:
    assert len({safe_name(text).upper() for text in NAMES}) == len(NAMES)


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("kept")
    out = tmp_path / "out"
    out.mkdir()
    (out / "stats.csv").symlink_to(precious)
    (out / "gone.csv").symlink_to(tmp_path / "nothing")
    for name in ("stats.csv", "gone.csv"):
        with pytest.raises(PlaceError, match="symbolic link"):
            write_whole(out / name, "lost")
        with pytest.raises(PlaceError, match="remove the link"):
            inside(out, name)
    with pytest.raises(PlaceError, match="symbolic link"):
        unlinked_tree(out)
    assert precious.read_text() == "kept"
    assert not (tmp_path / "nothing").exists()


def test_a_link_that_waits_under_the_unfinished_name_is_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("kept")
    (tmp_path / f".{os.getpid()}.a.txt").symlink_to(precious)
    write_whole(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "new"
    assert precious.read_text() == "kept"


def test_links_on_the_way_are_refused_and_the_folder_itself_may_be_one(tmp_path: Path) -> None:
    true = tmp_path / "true"
    (true / "sub").mkdir(parents=True)
    (tmp_path / "results").symlink_to(true)
    unlinked_below(tmp_path / "results", tmp_path / "results" / "sub" / "ses")
    (true / "other").symlink_to(tmp_path)
    with pytest.raises(PlaceError, match="other"):
        unlinked_below(tmp_path / "results", tmp_path / "results" / "other" / "ses")
    with pytest.raises(PlaceError, match="leaves"):
        unlinked_below(tmp_path / "results", tmp_path / "results" / ".." / "ses")


def test_what_fails_midway_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    place = tmp_path / "a"
    for make in (lambda p: p.write_text("half"), lambda p: p.mkdir()):
        place.write_text("old")
        with pytest.raises(ValueError, match="midway"), replacing(place) as part:  # noqa: PT012
            make(part)
            raise ValueError("midway")
        assert place.read_text() == "old"
        assert list(tmp_path.iterdir()) == [place]


def test_a_folder_takes_the_place_of_a_folder(tmp_path: Path) -> None:
    place = tmp_path / "a"
    for text in ("one", "two"):
        with replacing(place, replace_folder=True) as part:
            part.mkdir()
            (part / "x").write_text(text)
        assert (place / "x").read_text() == text
        assert list(tmp_path.iterdir()) == [place]
