"""Points of every form become the same points; what cannot be used ends in one sentence."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.io

from liex_lab.errors import LiexError
from liex_lab.exchange.points import PointNames, read_points

NAMES = ("snout", "left_hip", "right_hip")
N = 40
POINTS = np.random.default_rng(3).uniform(0.0, 90.0, (N, len(NAMES), 3)).round(3)
SCORES = np.full((N, len(NAMES)), 0.9)


def wide(folder: Path) -> Path:
    columns: dict[str, Any] = {
        f"{k}_{a}": POINTS[:, i, j] for i, k in enumerate(NAMES) for j, a in enumerate("xyz")
    }
    columns |= {f"{k}_error": np.ones(N) for k in NAMES} | {f"{k}_score": 0.9 for k in NAMES}
    pd.DataFrame(columns | {"fnum": np.arange(N)}).to_csv(folder / "wide.csv", index=False)
    return folder / "wide.csv"


def long(folder: Path) -> Path:
    rows = pd.DataFrame(POINTS.reshape(-1, 3), columns=list("xyz"))
    rows["keypoint"], rows["frame"] = NAMES * N, np.repeat(np.arange(N), len(NAMES))
    rows["likelihood"] = 0.9
    other = rows.assign(x=0.0)
    both = pd.concat([rows.assign(individual="a"), other.assign(individual="b")])
    both.sample(frac=1.0, random_state=1).to_csv(folder / "long.csv", index=False, sep=";")
    return folder / "long.csv"


def movement(folder: Path) -> Path:
    xarray = pytest.importorskip("xarray")
    shape = {"time": np.arange(N) / 20.0, "space": list("xyz"), "keypoint": list(NAMES)}
    position = np.moveaxis(POINTS, 1, 2)[..., None]
    data = xarray.Dataset(
        {
            "position": ((*shape, "individual"), position),
            "confidence": (("time", "keypoint", "individual"), SCORES[..., None]),
        },
        {**shape, "individual": ["a"]},
        {"time_unit": "seconds"},
    )
    data.to_netcdf(folder / "poses.nc", engine="h5netcdf")
    return folder / "poses.nc"


def dannce(folder: Path) -> Path:
    scipy.io.savemat(
        folder / "dannce.mat",
        {
            "pred": np.moveaxis(POINTS, 1, 2),
            "p_max": SCORES,
            "sampleID": 5.0 + 2.0 * np.arange(N)[None],
        },
    )
    return folder / "dannce.mat"


def archive(folder: Path) -> Path:
    times = 7.0 + np.arange(N) / 20.0
    np.savez(folder / "a.npz", points_mm=POINTS, points=NAMES, time_s=times, scores=SCORES)
    return folder / "a.npz"


@pytest.mark.parametrize("write", [wide, long, movement, dannce, archive])
def test_every_form_of_a_file_holds_the_same_points(write, tmp_path):
    names = PointNames(floor=0.0, fps=20.0, points=list(NAMES))
    if write in (long, movement):
        names = names.model_copy(update={"individual": "a"})
    found = read_points(write(tmp_path), names)
    order = [found.names.index(name) for name in NAMES]
    np.testing.assert_allclose(found.points_mm[:, order], POINTS)
    np.testing.assert_allclose(found.time_s, np.arange(N) / 20.0)
    assert found.scores is not None
    np.testing.assert_allclose(found.scores, 0.9)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_upward_axis_becomes_z_without_a_mirror_image(up, tmp_path):
    found = read_points(archive(tmp_path), PointNames(up=up, floor=0.0, unit="cm"))
    np.testing.assert_allclose(
        found.points_mm[..., 2],
        10.0 * (-1.0 if up[0] == "-" else 1.0) * POINTS[..., "xyz".index(up[-1])],
    )
    side = [np.linalg.det(p) for p in (found.points_mm[0], 10.0 * POINTS[0])]
    assert side[0] == pytest.approx(side[1])


def test_points_are_joints_by_their_name_or_by_a_table():
    joints = ("rump", "chest", "nose")
    assert PointNames().of_joints(joints, ["Snout", "tail_base", "ear"]) == {
        "rump": ["tail_base"],
        "nose": ["Snout"],
    }
    stated = PointNames(joints={"nose": "snout", "rump": ["left_hip", "right_hip"]})
    assert stated.of_joints(joints, NAMES)["rump"] == ["left_hip", "right_hip"]


def changed(folder: Path, **arrays: Any) -> Path:
    held: dict[str, Any] = {
        "points_mm": POINTS,
        "points": NAMES,
        "time_s": np.arange(N) / 20.0,
    } | arrays
    np.savez(folder / "b.npz", **{k: v for k, v in held.items() if v is not None})
    return folder / "b.npz"


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({"points_mm": POINTS[..., :2]}, "holds 2D points"),
        ({"points_mm": POINTS * [1.0, 1.0, 0.0]}, "2D points"),
        ({"points_mm": POINTS[:5], "time_s": np.arange(5)}, "has 5 frames, and 10 are needed"),
        ({"points_mm": POINTS * np.nan}, "no point in any frame"),
        ({"points": ["a", "b"]}, "has 3 points, and the names a, b"),
        ({"points": ["a", "b", "b"]}, "a name of its own"),
        ({"time_s": None}, "state it with --fps"),
        ({"time_s": np.arange(N)[::-1]}, "frames 0 and 1 at 39 s and 38 s"),
        ({"time_s": np.arange(N - 1)}, "has 40 frames and 39 times"),
        ({"points_mm": None}, "points_mm"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(arrays, sentence, tmp_path):
    with pytest.raises(LiexError, match=sentence) as raised:
        read_points(changed(tmp_path, **arrays), PointNames())
    assert "b.npz" in str(raised.value)


def test_two_animals_need_a_choice_and_a_table_without_z_is_refused(tmp_path):
    with pytest.raises(LiexError, match="holds the animals a, b; choose one with --individual"):
        read_points(long(tmp_path), PointNames(fps=20.0))
    flat = pd.read_csv(wide(tmp_path)).filter(regex="_x|_y|fnum")
    flat.to_csv(tmp_path / "flat.csv", index=False)
    with pytest.raises(LiexError, match="holds 2D points"):
        read_points(tmp_path / "flat.csv", PointNames(fps=20.0))
    with pytest.raises(LiexError, match="is not a file"):
        read_points(tmp_path / "none.csv", PointNames())


@pytest.mark.parametrize(
    ("joints", "sentence"),
    [
        ({"nase": "snout"}, "lists the joint nase, and this animal has rump, nose"),
        ({"nose": "snot", "rump": "left_hip"}, "no point snot; did you mean 'snout'"),
        ({"nose": "snout"}, "none is known of rump"),
        ({}, "none is known of rump"),
    ],
)
def test_a_wrong_table_of_names_states_what_the_file_has(joints, sentence):
    with pytest.raises(LiexError, match=sentence):
        PointNames(joints=joints).of_joints(("rump", "nose"), NAMES)


def test_an_unknown_entry_of_a_table_of_names_is_named(tmp_path):
    (tmp_path / "names.toml").write_text("ups = 'z'\n")
    with pytest.raises(LiexError, match="ups"):
        PointNames.load(tmp_path / "names.toml")
    (tmp_path / "names.toml").write_text("up = \n")
    with pytest.raises(LiexError, match="should be a TOML file"):
        PointNames.load(tmp_path / "names.toml")
