"""Raytrix exports: read through the profile that is named, refused where the numbers
contradict it.
"""

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.images.raytrix import (
    Profile,
    shipped_profiles,
)
from tests.recordings.asking import depths_in, facts_in, refusal
from tests.recordings.picture_writers import (
    points_of,
    write_folder,
    write_ply,
    write_raytrix,
    write_tiff,
    write_xyz,
)
from tests.recordings.writers import SMALL, depth_frames

STORED = depth_frames(3)
FLOAT = -STORED.astype(np.float32)
CALIBRATION = (
    '<RayCalibData version="1.0"><diameter units="pix">23.2</diameter><rotation '
    'units="rad">1.57</rotation>'
    '<tcp units="virtual_depth">2.25</tcp><lens_type id="0"><depth_range '
    'units="virtual_depth"><min>1.0</min>'
    "<max>3.2</max></depth_range></lens_type></RayCalibData>"
)


def png(path: Path, frame: np.ndarray) -> None:
    cv2.imwrite(str(path), frame)


def test_the_shipped_profiles_state_every_key_and_are_told_as_unconfirmed() -> None:
    for name, table in shipped_profiles().items():
        profile = Profile(name=name, **table)
        assert {
            "kind",
            "stored",
            "unit_mm",
            "offset_mm",
            "sign",
            "invalid",
            "valid_mm",
            "evidence",
        } <= set(table)
        assert profile.doubt is not None
        assert profile.evidence in profile.doubt


def test_float_maps_are_negative_millimetres(tmp_path: Path) -> None:
    stored = FLOAT - np.float32(0.25) * (FLOAT < 0)
    stored[0, 0, :4] = [np.nan, np.inf, 0.0, 30.0]
    folder = write_raytrix(tmp_path, stored, "raytrix-f32-negative-mm", ".tif", write_tiff)
    with open_recording(folder, strict=True) as recording:
        np.testing.assert_array_equal(recording.frame(0).depth[0, :4], 0.0)
        np.testing.assert_array_equal(recording.frame(2).depth, -stored[2])
        assert recording.format == "raytrix"
        assert [problem for problem in recording.problems if "not confirmed" in problem]
        profile = recording.metadata["profile"]
        assert (profile["name"], profile["sign"], profile["unit_mm"]) == (
            "raytrix-f32-negative-mm",
            -1,
            1.0,
        )


def test_sixteen_bits_are_ten_micrometres(tmp_path: Path) -> None:
    stored = (STORED[:, :, :] * 35).astype(np.uint16)  # around 245 mm
    stored[:, 0, 0], stored[:, 0, 1] = 65535, 65530  # unread, and farther than any tank
    folder = write_raytrix(tmp_path, stored, "raytrix-u16-10um", ".png", png)
    depth = depths_in(folder)[1]
    np.testing.assert_array_equal(depth[0, :2], [0.0, 0.0])
    np.testing.assert_allclose(depth[1:], stored[1, 1:] * 0.01, rtol=1e-6)


def test_what_is_stated_again_counts_and_a_confirmed_profile_is_silent(tmp_path: Path) -> None:
    more = (
        'sign = 1\nunit_mm = 2.0\noffset_mm = 5.0\nvalid_mm = [1000, 1500]\nevidence = "confirmed '
        'with a ruler"\n'
    )
    folder = write_raytrix(tmp_path, -FLOAT, "raytrix-f32-negative-mm", ".tif", write_tiff, more)
    with open_recording(folder) as recording:
        assert recording.problems == []
        expected = 2.0 * STORED[1] + 5.0
        np.testing.assert_allclose(recording.frame(1).depth, np.where(STORED[1] > 0, expected, 0))


@pytest.mark.parametrize(
    ("frames", "profile", "more", "says"),
    [
        (STORED, "raytrix-f32-negative-mm", "", "is uint16; choose another profile"),
        (-FLOAT, "raytrix-f32-negative-mm", "", "change sign to 1"),
        (FLOAT, "raytrix-f32-negative-mm", "valid_mm = [100, 300]", "valid_mm = [100, 300]"),
        (FLOAT / 1000, "raytrix-f32-negative-mm", "", "change unit_mm"),
        (FLOAT, "raytrix-f32-negative-mm", "valid_mm = [300, 100]", "nearest and a farthest"),
        (FLOAT, "raytrix-f32-negative-mm", "sign = 2", "sign"),
        (FLOAT, "raytrix-f32-negative-mm", "unit_mm = 0", "unit_mm"),
        (FLOAT, "raytrix-f32-negative-mm", "unit_mm = 'x'", "unit_mm"),
        (FLOAT, "raytrix-f32-negative-mm", "units_mm = 1", "did you mean 'unit_mm'"),
        (FLOAT, "raytrix-f32-negative-mm", "qqq = 1", "'qqq'"),
        (FLOAT, "raytrix-f32-negative-mm", "a = = 1", "should be a TOML file, but: "),
        (FLOAT, "raytrix-f64", "", "raytrix-f32-negative-mm, raytrix-u16-10um"),
        (FLOAT, "raytrix-u16-10um", "", "*.png"),
    ],
)
def test_numbers_that_contradict_the_profile_are_told_with_the_key_to_change(
    tmp_path: Path, frames: np.ndarray, profile: str, more: str, says: str
) -> None:
    folder = write_raytrix(tmp_path, frames, profile, ".tif", write_tiff, more)
    sentence = refusal(folder)
    assert says in sentence


def test_a_profile_may_be_stated_in_full_and_a_part_of_one_is_not_enough(tmp_path: Path) -> None:
    folder = write_raytrix(tmp_path, FLOAT, "raytrix-f32-negative-mm", ".tif", write_tiff)
    (folder / "raytrix.toml").write_text('kind = "metric"\n')
    assert "is not stated" in refusal(folder)
    table = shipped_profiles()["raytrix-f32-negative-mm"]
    lines = [
        f"{key} = {str(value) if key == 'invalid' else repr(value)}" for key, value in table.items()
    ]
    (folder / "raytrix.toml").write_text("\n".join(lines))
    np.testing.assert_array_equal(depths_in(folder)[1], STORED[1])


def test_false_colours_are_refused(tmp_path: Path) -> None:
    colours = np.zeros((2, 48, 64, 3), np.uint8)
    folder = write_raytrix(tmp_path, colours, "raytrix-f32-negative-mm", ".tif", png)
    assert "got an 8-bit colour image" in refusal(folder)


def test_exports_without_a_profile_say_what_to_write(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "maps", FLOAT, ".tif", write_tiff)
    (folder / "camera.toml").unlink()
    for path in folder.glob("*.tif"):
        path.rename(folder / f"DepthMap_{path.name}")
    assert 'profile = "raytrix-f32-negative-mm"' in refusal(folder)
    clouds = write_folder(tmp_path / "clouds", STORED, ".xyz", write_xyz)
    (clouds / "camera.toml").unlink()
    assert "raytrix-points-mm" in refusal(clouds)
    assert "raytrix.toml" in refusal(clouds / "frame_0.xyz")
    plain = write_folder(tmp_path / "plain", STORED, ".tif", write_tiff)
    (plain / "camera.toml").unlink()
    (plain / "grid.xml").write_text(CALIBRATION)
    assert "raytrix.toml" in refusal(plain)


def test_the_intrinsics_may_follow_from_the_lens_and_say_so(tmp_path: Path) -> None:
    lens = "focal_mm = 35.0\npitch_mm = 0.0055\n"
    folder = write_raytrix(tmp_path, FLOAT, "raytrix-f32-negative-mm", ".tif", write_tiff, lens)
    assert facts_in(folder).camera.source == "camera.toml"
    (folder / "camera.toml").unlink()
    with open_recording(folder) as recording:
        camera = recording.camera
        assert camera.fx == camera.fy == pytest.approx(35.0 / (0.0055 * 2))
        assert (camera.cx, camera.cy, camera.source) == (31.5, 23.5, "raytrix.toml")
        assert any("measure a ruler" in problem for problem in recording.problems)


def test_virtual_depth_without_a_calibration_is_refused_with_the_reason(tmp_path: Path) -> None:
    folder = write_raytrix(tmp_path, FLOAT, "raytrix-virtual", ".tif", write_tiff)
    sentence = refusal(folder)
    assert "virtual, which is relative" in sentence
    assert "lens_f_mm" in sentence
    (folder / "grid.xml").write_text(CALIBRATION)
    assert "no metric scale" in refusal(folder)


@pytest.mark.parametrize("raw", [False, True])
def test_virtual_depth_with_a_calibration_obeys_the_thin_lens(tmp_path: Path, raw: bool) -> None:
    f, to_grid, gap = 35.0, 34.0, 1.0
    distance = np.where(STORED > 0, STORED, np.nan).astype(float)
    v = (
        distance * f / (distance - f) - to_grid
    ) / gap  # 1 / f = 1 / distance + 1 / image, image = to_grid + v gap
    stored = np.nan_to_num(1.0 - 1.0 / v if raw else v).astype(np.float32)
    more = (
        f"lens_f_mm = {f}\nlens_to_grid_mm = {to_grid}\ngrid_to_sensor_mm = {gap}\n"
        + 'virtual = "raw"\n' * raw
    )
    folder = write_raytrix(tmp_path, stored, "raytrix-virtual", ".tif", write_tiff, more)
    np.testing.assert_allclose(depths_in(folder), STORED, rtol=2e-4)


@pytest.mark.parametrize(
    ("suffix", "write"),
    [
        (".xyz", write_xyz),
        (".xyz", partial(write_xyz, separator=",")),
        (".xyz", partial(write_xyz, separator="; ")),
        (".xyz", partial(write_xyz, separator="\t", header="x\ty\tz")),
        (".ply", partial(write_ply, form="ascii")),
        (".ply", partial(write_ply, form="binary_little_endian")),
        (".ply", partial(write_ply, form="binary_big_endian")),
    ],
)
def test_points_are_seen_by_the_camera(tmp_path: Path, suffix: str, write: Any) -> None:
    folder = write_raytrix(tmp_path, STORED, "raytrix-points-mm", suffix, write)
    np.testing.assert_allclose(depths_in(folder, strict=True), STORED, atol=1e-3)


def test_the_nearest_point_in_a_pixel_counts_and_axes_are_as_stated(tmp_path: Path) -> None:
    def write(path: Path, frame: np.ndarray) -> None:
        p = points_of(frame) * [1.0, -1.0, -1.0] / 10.0  # y down, z ahead, centimetres
        order = np.random.default_rng(0).permutation(2 * len(p))
        both = np.concatenate([p, p * 1.1])[order]  # a second one behind each
        path.write_text("\n".join(f"7 {z} {y} {x}" for x, y, z in both))

    more = "unit_mm = 10.0\nsign = 1\nup = false\ncolumns = [3, 2, 1]\n"
    folder = write_raytrix(tmp_path, STORED, "raytrix-points-mm", ".txt", write, more)
    np.testing.assert_allclose(depths_in(folder)[0], STORED[0], atol=1e-3)


def test_points_need_a_camera_with_a_size(tmp_path: Path) -> None:
    folder = write_raytrix(tmp_path, STORED, "raytrix-points-mm", ".xyz", write_xyz)
    (folder / "camera.toml").write_text("[camera]\nfx = 60\nfy = 61\ncx = 31.5\ncy = 23.5\n")
    assert "width and height" in refusal(folder)
    wide = Camera(30.0, 30.5, 15.75, 11.75, 32, 24)
    assert depths_in(folder, camera=wide)[0].shape == (24, 32)
    (folder / "raytrix.toml").write_text('profile = "raytrix-points-mm"\npattern = "*.ply"')
    assert "'*.ply'" in refusal(folder, camera=SMALL)
