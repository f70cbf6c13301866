"""The NYU layout: its images as a recording, its joints beside them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from liex_lab.body import Pose, Skeleton
from liex_lab.errors import LiexError, RecordingError
from liex_lab.geometry import SE3
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.images.nyu import (
    LABEL_CAMERA,
    N_FIRST_PERSON,
    NYU_CAMERA,
    NYU_IDS,
    POINTS,
    REFERENCE_FILE,
    NyuReference,
    fit_hands,
    points_of_joints,
    read_nyu_joints,
    uvd_to_mm,
)
from tests.recordings.asking import depths_in, refusal
from tests.recordings.picture_writers import write_nyu
from tests.recordings.writers import depth_frames, even_times, write_times

STORED = depth_frames(12)


def test_its_camera_is_known_and_its_rate_assumed(tmp_path: Path) -> None:
    folder = write_nyu(tmp_path / "test", depth_frames(2, 640, 480))
    (folder / "camera.toml").unlink()
    with open_recording(folder) as recording:
        camera = recording.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (
            588.036865,
            587.075073,
            320.0,
            240.0,
        )
        assert camera.source == "NYU hand pose data set"
        assert any("constant 30 frames/s was assumed" in problem for problem in recording.problems)
    write_times(folder, even_times(2))
    with open_recording(folder) as recording:
        assert (recording.times_ns.tolist(), recording.problems) == (even_times(2), [])
    with open_recording(folder / "depth_1_0000002.png", fps=30) as recording:
        assert (len(recording), recording.format) == (1, "nyu")


def test_the_first_view_is_read_and_its_real_pictures(tmp_path: Path) -> None:
    folder = write_nyu(tmp_path, STORED)
    for name in ("depth_2_0000001.png", "synthdepth_1_0000001.png", "rgb_1_0000001.png"):
        cv2.imwrite(str(folder / name), np.full((48, 64, 3), 9, np.uint8))
    np.testing.assert_array_equal(depths_in(folder), STORED)


def test_sixteen_bit_pictures_of_that_name_are_pictures(tmp_path: Path) -> None:
    folder = write_nyu(tmp_path, STORED[:0])
    for k, frame in enumerate(STORED):
        cv2.imwrite(str(folder / f"depth_1_{k + 1:07d}.png"), frame)
    with open_recording(folder, fps=30) as recording:
        assert recording.format == "images"
        np.testing.assert_array_equal(recording.frame(11).depth, STORED[11])


def joint_file(folder: Path, **other: Any) -> np.ndarray:
    """A joint_data.mat as the data set has it, of three views; what joint_uvd holds."""
    rng = np.random.default_rng(2)
    uvd = rng.uniform([0, 0, 400], [639, 479, 1200], (3, 5, 36, 3))
    u, v, d = np.moveaxis(uvd, -1, 0)
    lens = NYU_CAMERA
    xyz = np.stack([(u - lens.cx) * d / lens.fx, (lens.cy - v) * d / lens.fy, d], axis=-1)  # y up
    names = np.array([f"F1_KNU{k}" for k in range(36)], object)
    savemat(
        folder / "joint_data.mat",
        {"joint_uvd": uvd, "joint_xyz": xyz, "joint_names": names} | other,
    )
    return uvd


def test_joints_are_where_the_camera_sees_them(tmp_path: Path) -> None:
    uvd = joint_file(tmp_path)
    for given, view in ((tmp_path, 1), (tmp_path / "joint_data.mat", 3)):
        joints = read_nyu_joints(given, view=view)
        np.testing.assert_array_equal(joints.uvd, uvd[view - 1])
        np.testing.assert_allclose(
            NYU_CAMERA.project(joints.xyz), uvd[view - 1, ..., :2], atol=1e-9
        )
        assert joints.names == tuple(f"F1_KNU{k}" for k in range(36))


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"joint_uvd": np.zeros((3, 5, 14, 3))}, "(views, frames, 36, 3)"),
        ({"joint_uvd": np.zeros(3)}, "(views, frames, 36, 3)"),
        ({"joint_xyz": np.zeros((3, 4, 36, 3))}, "(3, 4, 36, 3)"),
    ],
)
def test_joints_of_another_shape_are_refused(
    tmp_path: Path, other: dict[str, Any], says: str
) -> None:
    joint_file(tmp_path, **other)
    with pytest.raises(RecordingError) as error:
        read_nyu_joints(tmp_path)
    assert says in str(error.value)


def test_a_file_that_holds_no_joints_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no joint_data\.mat"):
        read_nyu_joints(tmp_path)
    savemat(tmp_path / "joint_data.mat", {"joint_uvd": np.zeros((3, 5, 36, 3))})
    with pytest.raises(RecordingError, match="joint_xyz, joint_names"):
        read_nyu_joints(tmp_path)
    joint_file(tmp_path)
    whole = (tmp_path / "joint_data.mat").read_bytes()
    rng = np.random.default_rng(0)
    for content in [
        b"",
        b"text",
        whole[:200],
        whole[:9000],
        *(bytes(rng.integers(0, 256, 500, np.uint8)) for _ in range(5)),
    ]:
        (tmp_path / "joint_data.mat").write_bytes(content)
        with pytest.raises(RecordingError, match=r"joint_data\.mat"):
            read_nyu_joints(tmp_path)


def test_a_folder_of_other_views_only_says_which_is_missing(tmp_path: Path) -> None:
    folder = write_nyu(tmp_path, STORED[:1])
    (folder / "depth_1_0000001.png").rename(folder / "depth_2_0000001.png")
    assert "depth_1_0000001.png" in refusal(folder)


@pytest.mark.parametrize("view", [-1, 0, 4])
def test_a_view_that_there_is_not_is_refused(tmp_path: Path, view: int) -> None:
    joint_file(tmp_path)
    with pytest.raises(RecordingError, match=r"1 to 3|should hold joints"):
        read_nyu_joints(tmp_path, view=view)


# The labels of the NYU data: read, checked, and held against our skeleton.


HAND = Skeleton.load("hand")


def labels(n: int) -> np.ndarray:
    """Pixels and depths (n, 14, 3) of hands in some postures."""
    rng = np.random.default_rng(1)
    angles = 0.6 * rng.uniform(HAND.limits[..., 0], HAND.limits[..., 1], (n, HAND.n_joints, 3))
    pose = Pose(
        SE3(SE3.exp(rng.normal(0.0, 0.5, (n, 6))).rotation, np.tile([0.0, 0.0, 700.0], (n, 1))),
        angles,
        np.ones(n),
    )
    points = points_of_joints(HAND) @ pose.joints(HAND)
    return np.concatenate([LABEL_CAMERA.project(points), points[..., 2:]], axis=-1)


def test_hands_are_found_from_their_fourteen_points() -> None:
    points = uvd_to_mm(labels(20))
    assert fit_hands(HAND, points).residual_mm.mean() < 0.5


def test_our_skeleton_fits_both_people_of_the_test_set(reference_data: Path) -> None:
    truth = NyuReference.load(reference_data / "hand_nyu").truth
    for rows, size in (
        (slice(0, N_FIRST_PERSON, 240), 1.09),
        (slice(N_FIRST_PERSON, None, 600), 0.91),
    ):
        fit = fit_hands(HAND, truth[rows])
        assert fit.residual_mm.mean() < 3.0  # the labels' own scatter is about that
        assert np.median(fit.pose.scale) == pytest.approx(size, abs=0.03)


def test_labels_come_from_the_data_sets_own_file_as_well(tmp_path: Path) -> None:
    uvd = np.zeros((3, 4, 36, 3))
    uvd[0][:, NYU_IDS] = labels(4)
    names = np.array([[f"P{k}" for k in range(36)]], dtype=object)
    savemat(tmp_path / "joint_data.mat", {"joint_uvd": uvd, "joint_xyz": uvd, "joint_names": names})
    reference = NyuReference.load(tmp_path)
    np.testing.assert_allclose(reference.truth, uvd_to_mm(labels(4)))
    assert reference.answers == {}


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LiexError, match="has neither"):
        NyuReference.load(tmp_path)
    (tmp_path / REFERENCE_FILE).write_bytes(b"PK\x03\x04 not an archive")
    with pytest.raises(LiexError, match="should be a whole file of NYU labels"):
        NyuReference.load(tmp_path)
    np.savez(
        tmp_path / REFERENCE_FILE, groundtruth_uvd=labels(2), joint_names=np.array([*POINTS][::-1])
    )
    with pytest.raises(LiexError, match="in this order"):
        NyuReference.load(tmp_path)
