"""What is drawn and measured of a body follows from its joints, not from being a mouse."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour.body import (
    BRANCHES,
    KINDS,
    BodyAxis,
    drawn_measures,
    kind_of,
    logged_of,
    parents_of,
)
from liex_lab.behaviour.kinematics import Joints, kinematics
from liex_lab.behaviour.summary import measure
from liex_lab.body.skeleton import Skeleton
from liex_lab.tables.schema import FRAMES, table_columns, to_pandas

HAND = Skeleton.load("hand")


def animal(name: str) -> dict[str, object]:
    skeleton = Skeleton.load(name)
    return {"joints": list(skeleton.names), "bones": [list(edge) for edge in skeleton.edges]}


def words(name: str) -> str:
    return " ".join(f"{one.title} {one.what}" for one in logged_of(animal(name)))


def test_each_animal_has_the_drawn_measures_what_it_has():
    assert [one.title for one in drawn_measures(animal("mouse"))] == ["Speed", "Nose height"]
    assert "Tail beat" in words("fish")
    assert "nose" not in words("fish").lower()
    hand = words("hand")
    assert "Height of the palm above the background" in hand
    assert "Opening of thumb, index, middle, ring and little" in hand
    assert not {"nose", "tail", "bend", "floor"} & set(hand.lower().split())


def test_a_chain_without_a_nose_is_named_by_its_own_joint():
    snake = {"joints": ["tail_end", "belly", "snout"], "bones": [[0, 1], [1, 2]]}
    assert [one.title for one in drawn_measures(snake)] == ["Speed", "Snout height"]


def test_the_parts_of_a_hand_are_its_palm_and_fingers():
    body = BodyAxis.of(HAND.names, parents_of(animal("hand")))
    assert body.kind == BRANCHES
    assert [HAND.names[limb[-1]] for limb in body.limbs] == [
        f"{finger}_tip" for finger in ("thumb", "index", "middle", "ring", "little")
    ]
    assert [HAND.names[k] for k in body.axis] == ["palm", "middle_root"]
    assert not [HAND.names[k] for k in body.trunk if HAND.names[k].endswith(("end", "tip"))]


def test_an_animal_with_paws_still_has_a_nose():
    joints = ["rump", "neck", "nose", "left_knee", "left_paw", "right_knee", "right_paw"]
    body = BodyAxis.of(joints, [-1, 0, 1, 1, 3, 1, 5])
    assert (body.kind, body.front, body.rear) == ("stands", 2, 0)


def test_the_columns_tell_the_kind_of_body():
    for kind in KINDS:
        assert kind_of(column.name for column in table_columns("kinematics", kind)) == kind


def frames_of(n: int) -> pd.DataFrame:
    empty = {column.name: np.zeros(n) for column in FRAMES}
    table = to_pandas(FRAMES, {**empty, "session_id": "s", "individual": "hand"})
    return table.assign(frame_index=np.arange(n), time_s=np.arange(n) / 30.0, dt_s=1 / 30.0)


def joints_of(bent_rad: float) -> np.ndarray:
    """(J, 3) joints of a hand whose fingers' hinges are bent by so much."""
    placed = {0: (np.eye(3), np.zeros(3))}
    for k in range(1, len(HAND.names)):
        turn, at = placed[int(HAND.parents[k])]
        hinge = HAND.names[k].endswith(("middle", "end")) and HAND.axes[k].any()
        c, s = (np.cos(bent_rad), np.sin(bent_rad)) if hinge else (1.0, 0.0)
        bend = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        placed[k] = (turn @ HAND.rest[k] @ bend, at + turn @ HAND.offsets[k])
    return np.stack([placed[k][1] for k in range(len(HAND.names))])


def test_a_closing_hand_opens_less_and_has_no_nose():
    joints = np.stack([joints_of(bend) for bend in (0.0, 0.5, 1.0)])
    parents = parents_of(animal("hand"))
    source = Joints(
        list(HAND.names), 3, lambda rows: (joints[rows], np.ones(joints[rows].shape[:2])), parents
    )
    moved = kinematics(frames_of(3), source)
    opening = moved["opening"].to_numpy()
    by_hand = []
    for pose in joints:
        shares = []
        for finger in ("thumb", "index", "middle", "ring", "little"):
            chain = [0] + [k for k, name in enumerate(HAND.names) if name.startswith(finger)]
            bones = sum(np.linalg.norm(pose[b] - pose[a]) for a, b in pairwise(chain))
            shares.append(np.linalg.norm(pose[chain[-1]] - pose[0]) / bones)
        by_hand.append(np.mean(shares))
    assert opening == pytest.approx(by_hand)
    assert 0.9 < opening[0] <= 1.0
    assert (np.diff(opening) < -0.05).all()
    assert not [name for name in moved if "nose" in str(name) or "rump" in str(name)]
    # bent fingers do not move the hand
    assert np.ptp(moved["x_mm"]) == pytest.approx(0.0, abs=1e-9)


def test_a_hand_has_no_measures_of_rears_in_its_bouts():
    joints = np.stack([joints_of(0.2)] * 30)
    source = Joints(
        list(HAND.names),
        30,
        lambda rows: (joints[rows], np.ones(joints[rows].shape[:2])),
        parents_of(animal("hand")),
    )
    found = measure(frames_of(30), source)
    assert list(found.bouts["action"]) == ["pause"]
    assert not [name for name in found.bouts if "nose" in str(name) or "height" in str(name)]
    assert not [column for column in table_columns("bouts", BRANCHES) if "nose" in column.name]
    assert "distance_moving_m" in found.summary
