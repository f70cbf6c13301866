"""RFID readings identify several animals, and nothing where they cannot be right."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from liex_lab.errors import LiexError, PlanError
from liex_lab.plan import Plan
from liex_lab.plan.sections import Circle, Rfid
from liex_lab.scene.scene import UNKNOWN, Arena
from liex_lab.tracking.identity import doubt, identify
from liex_lab.tracking.rfid import Readings, read_readings
from tests.tracking.stories import SUBJECT, lose
from tests.tracking.test_identity import LOST, SECONDS, mixed

ARENA = Arena("round", (0.0, 0.0), radius_mm=200.0)
TAGS = ("ada", "bob")
N = len(SECONDS)


def stated(file: Path, **more: Any) -> Rfid:
    antennas = {
        "A": Circle(centre=[0.0, 0.0], radius=40.0),
        "B": Circle(centre=[90.0, 0.0], radius=40.0),
    }
    values: dict[str, Any] = {"readings": str(file), "tags": [*TAGS], "antennas": antennas}
    return Rfid(**values | more)


def read(folder: Path, lines: str, arena: Arena = ARENA, **more: Any) -> Readings:
    file = folder / "readings.csv"
    file.write_text(f"time_s,antenna,id\n{lines}")
    return read_readings(stated(file, **more), 10.0, 2, arena)


def unclear() -> tuple:
    """Two animals that meet slowly and part, so that motion does not distinguish them."""
    order = np.tile([0, 1], (N, 1))
    shown = mixed(2, order)
    lose(shown, LOST)
    middle = 0.5 * (shown.place[:, :1] + shown.place[:, 2:3])
    apart = np.clip(np.abs(np.arange(N) - 47.0) / 400.0, 0.0, 1.0)
    shown.place[:] = middle + apart[:, None, None] * (shown.place - middle)
    shown.centroid_mm[:] = shown.place
    shown.place[LOST] = shown.centroid_mm[LOST] = np.nan
    return [shown] * 2, [SUBJECT] * 2


def spread() -> tuple:
    """The same animals farther apart, so that antennas distinguish them."""
    shown, subjects = unclear()
    away = np.array([[-200.0, 0, 0], [200.0, 0, 0]], np.float32).repeat(2, axis=0)
    late = np.clip(np.abs(np.arange(N) - 47.0) - 8.0, 0.0, 20.0)[:, None, None] / 20.0
    for one in (shown[0].place, shown[0].centroid_mm):
        one[:, :4] += (late * away).astype(np.float32)
    return shown, subjects


@pytest.mark.parametrize("crossed", [False, True])
def test_readings_after_a_crossing_decide_which_is_which(crossed: bool) -> None:
    shown, subjects = spread()
    before = identify(shown, subjects)
    assert max(one.p_swap for one in before.crossings) > 0.1
    rows, slots = np.array([5, 12, 75, 85]), np.array([0, 1, 0, 1])
    tags = np.array([0, 1, *([1, 0] if crossed else [0, 1])])
    places = shown[0].centroid_mm[rows, 2 * slots, :2]
    readings = Readings(TAGS, tags, SECONDS[rows], np.column_stack([places, np.full(4, 30.0)]))
    found = identify(shown, subjects, readings)
    ada = found.tags.index("ada")
    assert (found.slots[: LOST.start, ada] == 0).all()
    assert (found.slots[LOST.stop :, ada] == int(crossed)).all()
    assert max(one.p_swap for one in found.crossings) < 0.01
    assert "rfid" in {one.decided_by for one in found.crossings}
    assert doubt(found.crossings) == ""
    assert (found.misfits, found.remarks) == ((), ())


def test_readings_where_no_animal_is_change_nothing_and_are_reported() -> None:
    shown, subjects = spread()
    before = identify(shown, subjects)
    nowhere = np.tile([900.0, 900.0, 30.0], (6, 1))
    readings = Readings(TAGS, np.array([0, 1] * 3), SECONDS[[5, 12, 20, 75, 80, 85]], nowhere)
    found = identify(shown, subjects, readings)
    np.testing.assert_array_equal(found.slots, before.slots)
    assert found.crossings == before.crossings
    assert found.misfits[0].startswith("at 6 of 6 RFID readings the animal is not at the antenna")
    assert found.tags == ()
    wide = np.tile([0.0, 0.0, 2000.0], (2, 1))  # both animals are within its range
    readings = Readings(TAGS, np.array([0, 1]), SECONDS[[5, 12]], wide)
    found = identify(shown, subjects, readings)
    assert found.tags == ()
    assert "2 RFID readings do not distinguish the animals" in found.misfits[0]


def test_one_wrong_reading_does_not_exchange_animals_that_stay_apart() -> None:
    shown, subjects = spread()
    rows, slots = np.array([5, 12, 20, 30]), np.array([0, 1, 0, 0])
    places = shown[0].centroid_mm[rows, 2 * slots, :2]
    antennas = np.column_stack([places, np.full(4, 30.0)])
    readings = Readings(TAGS, np.array([0, 1, 0, 1]), SECONDS[rows], antennas)
    found = identify(shown, subjects, readings)
    assert (found.slots[:30, found.tags.index("ada")] == 0).all()
    assert found.remarks == ("at 1 of 4 RFID readings the animal is not at the antenna",)


def test_readings_that_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        "-2,A,ada\n0.5,A,ada\n0.6,A,ada\n1.2,A,eve\n2.0,B,ada\n2.05,B,bob\n3,B,bob\n11,A,ada\n",
    )
    assert found.time_s.tolist() == [0.5, 3.0], "readings of a stay are one"
    assert found.tag.tolist() == [0, 1]
    assert found.antenna_mm.tolist() == [[0.0, 0.0, 40.0], [90.0, 0.0, 40.0]]
    assert found.remarks == (
        "2 of 8 RFID readings are outside the recording (check animal.rfid.offset_s), and left out",
        "1 of 8 RFID readings are of other tags (eve), and left out",
        "2 of 8 RFID readings are of two tags at one antenna at once, and left out",
    )
    shifted = read(tmp_path, "1000.5,A,ada\n", offset_s=-1000.0)
    assert shifted.time_s.tolist() == pytest.approx([0.5])


@pytest.mark.parametrize(
    ("lines", "more", "message"),
    [
        ("1,A,ada\n0.5,A,ada\n", {}, "line 3 of .* is earlier than the one before"),
        ("1,C,ada\n", {}, "has readings at C, whose place is not stated"),
        ("1000,A,ada\n", {}, r"\(1000 to 1000 s\) is in the recording \(0 to 10.000 s\).*offset_s"),
        ("", {}, "no reading of"),
        ("soon,A,ada\n", {}, "should be a table of RFID readings with the columns time_s, antenna"),
        ("1,A,ada\n", {"tags": ["a", "b", "c"]}, r"states 3 tags \(a, b, c\), and 2 animals"),
        (
            "1,A,ada\n",
            {"antennas": {"A": Circle(centre=[900.0, 0.0], radius=40.0)}},
            "the antenna A is outside the arena",
        ),
    ],
)
def test_a_bad_file_or_plan_gives_a_sentence(
    tmp_path: Path, lines: str, more: dict[str, Any], message: str
) -> None:
    with pytest.raises(LiexError, match=message):
        read(tmp_path, lines, **more)


def test_what_is_not_known_of_the_arena_or_not_a_table_is_no_traceback(tmp_path: Path) -> None:
    assert len(read(tmp_path, "1,A,ada\n", arena=UNKNOWN).tag) == 1
    for text in ("time_s,id\n1,ada\n", "\x00"):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(LiexError, match="should be a table of RFID readings"):
            read_readings(stated(tmp_path / "bad.csv"), 10.0, 2, ARENA)
    with pytest.raises(LiexError, match="should be a table"):
        read_readings(stated(tmp_path / "absent.csv"), 10.0, 2, ARENA)
    rfid = (
        "animal.rfid={readings='r.csv', tags=['a'], antennas={A={centre=[0.0, 0.0], radius=9.0}}}"
    )
    with pytest.raises(PlanError, match="distinguishes several animals, and count is 1"):
        Plan.load("mouse").with_settings([rfid])
    plan = Plan.load("mouse").with_settings(["animal.count=2", rfid])
    assert Plan.from_toml(plan.to_toml()) == plan
    with pytest.raises(ValidationError):
        Rfid(readings="r.csv", tags=[], antennas={})
