"""What other programs are known to get wrong about units, and what comes out here instead.

The numbers are those of BEHAVIOUR's list of unit defects (MoSeq's extraction of early 2024), in its
order. Its thirteenth, a failed flip classifier that turns every frame round, has no counterpart:
nothing here is turned round behind the user's back, and what will be is a row of flips.parquet.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.build import build_recording
from liex_lab.pipelines.doctor import examine
from numpy.typing import NDArray

from liex_lab.behaviour.kinematics import kinematics
from liex_lab.optics import camera as cameras
from liex_lab.optics.camera import KINECT_V2, PRIMESENSE, PRIMESENSE_QVGA, Camera, Distortion, Water
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import Patches
from liex_lab.scene.learning import learn_scene
from liex_lab.simulation.sensors import BY_NAME
from tests.behaviour.test_kinematics import tables_of
from tests.oracles.plate import Plate
from tests.recordings.writers import depth_frames, even_times, write_moseq_folder, write_png_folder
from tests.scene.staged import bare_floor
from tests.sessions.walking_mouse import WalkingMouse, steady, write

Array = NDArray[np.float64]

PRESETS = [value for value in vars(cameras).values() if isinstance(value, Camera)]
PRESETS += [sensor.camera for sensor in BY_NAME.values() if sensor.camera not in PRESETS]
BARREL = Distortion.of("rational_polynomial", [-0.2, 0.03, 0.001, -0.0005, 0.0, 0.02, 0.0, 0.0])
PINCUSHION = Distortion.of("plumb_bob", [0.12, -0.02])
FISHEYE = Distortion.of("equidistant", [-0.03, 0.004])
FLOOR_MM = 673.1


def plates(
    camera: Camera, floor_mm: float, side_mm: float, high_mm: float = 20.0, n: int = 6
) -> list[Plate]:
    """A square plate at places and angles all over the picture's middle."""
    rng = np.random.default_rng(4)
    reach = 0.25 * floor_mm * np.array([camera.width / camera.fx, camera.height / camera.fy])
    return [
        Plate(floor_mm, side_mm, high_mm, (float(x), float(y)), float(turn))
        for x, y, turn in zip(
            *rng.uniform(-1, 1, (2, n)) * reach[:, None], rng.uniform(0.1, 0.7, n), strict=True
        )
    ]


def measured(
    folder: Path, camera: Camera, shown: list[Plate], water: Water | None = None
) -> tuple[Array, Array, Array]:
    """The product's own path, from pictures on disk to (area mm^2, sides mm (2,), centre mm (3,))
    of each frame.
    """
    pictures = np.rint(8.0 * np.stack([plate.depth(camera, water) for plate in shown])).astype(
        np.uint16
    )
    bent = camera.distortion
    lens: dict[str, Any] = {}
    if bent is not None:
        lens = {"distortion_model": bent.model, "distortion": list(bent.coefficients)}
    path = write_png_folder(folder, pictures, camera, unit_mm=0.125, **lens)
    told = (
        [] if water is None else [f"water.{key}={value}" for key, value in water.to_dict().items()]
    )
    with build_recording(path, Plan().with_settings(told)) as recording:
        scene, sample = learn_scene(recording, (40.0, 115.0))
        crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    T_camera_arena = scene.floor.T_arena_camera.inverse()
    heights = crops.moments[:, 2] / crops.moments[:, 1]
    up = np.zeros(3) if water is None else water.lift_mm
    centre = T_camera_arena @ np.column_stack([crops.moments[:, 3:5], heights]) - up
    return crops.moments[:, 1], crops.moments[:, 6:8] * np.sqrt(12.0), centre


def check_square(
    folder: Path, camera: Camera, floor_mm: float = 650.0, water: Water | None = None
) -> None:
    """Area, sides, depth and place of a square within 1 %; of a single picture its sides within a
    pixel, too.
    """
    shown = plates(camera, floor_mm, 80.0)
    area, sides, centre = measured(folder, camera, shown, water)
    pixel = floor_mm / camera.fx
    np.testing.assert_allclose([np.sqrt(area).mean(), *sides.mean(axis=0)], 80.0, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(area), 80.0, atol=max(0.8, 0.5 * pixel))
    np.testing.assert_allclose(sides, 80.0, atol=max(0.8, pixel))
    np.testing.assert_allclose(centre[:, 2], floor_mm - 20.0, atol=0.5)
    np.testing.assert_allclose(centre[:, :2], [plate.centre for plate in shown], atol=0.8)


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(camera, id=camera.source, marks=pytest.mark.nightly if k % 3 else ())
        for k, camera in enumerate(PRESETS)
    ],
)
def test_a_square_is_as_large_as_it_is_for_every_camera_preset(
    tmp_path: Path, camera: Camera
) -> None:
    check_square(tmp_path / "r", camera)


@pytest.mark.parametrize(
    ("camera", "lens"),
    [
        pytest.param(KINECT_V2, BARREL, id="barrel"),
        pytest.param(PRIMESENSE, PINCUSHION, id="pincushion", marks=pytest.mark.nightly),
        pytest.param(KINECT_V2, FISHEYE, id="fisheye"),
    ],
)
def test_and_through_a_bent_lens(tmp_path: Path, camera: Camera, lens: Distortion) -> None:
    check_square(tmp_path / "r", replace(camera, distortion=lens))


@pytest.mark.parametrize(
    ("camera", "water"),
    [
        pytest.param(KINECT_V2, Water(450.0, ranging="time_of_flight"), marks=pytest.mark.nightly),
        pytest.param(
            PRIMESENSE_QVGA,
            Water(450.0, ranging="structured_light"),
            marks=pytest.mark.nightly,
        ),
        (PRIMESENSE_QVGA, Water(400.0, 1.34, 0.04, -0.03, "structured_light")),
        pytest.param(
            replace(KINECT_V2, distortion=BARREL),
            Water(400.0, ranging="light_field"),
            marks=pytest.mark.nightly,
        ),
    ],
    ids=["time of flight", "structured light", "tilted", "bent lens and light field"],
)
def test_and_through_water(tmp_path: Path, camera: Camera, water: Water) -> None:
    """As the camera reports it the floor is off by far more than 1 %."""
    check_square(tmp_path / "r", camera, 600.0, water)
    assert abs(np.median(Plate(600.0, 80.0).depth(camera, water)) - 600.0) > 30.0


def test_1_the_focal_length_comes_from_the_tangent_of_the_angle_of_view() -> None:
    """Stated are 70.6 x 60 degrees: 361.6 and 367.2 px. The angle in place of its tangent gives
    415.5 and 404.9.
    """
    width, height = KINECT_V2.width, KINECT_V2.height
    stated = [width / 2 / np.tan(np.radians(70.6) / 2), height / 2 / np.tan(np.radians(60.0) / 2)]
    np.testing.assert_allclose([KINECT_V2.fx, KINECT_V2.fy], stated, rtol=0.01)


@pytest.mark.parametrize(("focal", "expected"), [(365.0, 184.4), (504.0, 133.6)])
def test_2_and_3_lengths_follow_the_camera_that_made_the_picture(
    tmp_path: Path, focal: float, expected: float
) -> None:
    """100 px at 673.1 mm. One camera's constants for all would say 162 and 166 mm."""
    own = Camera(focal, focal, 255.5, 211.5, 512, 424)
    path = write_png_folder(tmp_path / "r", depth_frames(1, 512, 424), own)
    with build_recording(path, Plan()) as recording:
        ends = recording.camera.unproject(
            [[255.5, 211.5], [355.5, 211.5], [255.5, 311.5]], FLOOR_MM
        )
    np.testing.assert_allclose(np.linalg.norm(ends[1:] - ends[0], axis=1), expected, atol=0.05)


def test_4_a_tall_animal_is_where_it_is_and_not_where_its_shadow_is(tmp_path: Path) -> None:
    """40 mm above a floor at 673.1 mm: at the floor's depth its way would come out 6.3 %
    too long.
    """
    shown = [Plate(FLOOR_MM, 70.0, 40.0, (x, 30.0)) for x in (-150.0, -80.0, 0.0, 70.0, 150.0)]
    _, _, centre = measured(tmp_path / "r", KINECT_V2, shown)
    np.testing.assert_allclose(np.diff(centre[:, 0]), [70.0, 80.0, 70.0, 80.0], rtol=0.01)


def test_5_an_area_is_scaled_along_both_axes(tmp_path: Path) -> None:
    """1000 px at 673.1 mm with f = 365 px are 3401 square millimetres, not 1641 of something."""
    side = np.sqrt(1000.0) * (FLOOR_MM - 20.0) / 365.0
    area, _, _ = measured(tmp_path / "r", KINECT_V2, plates(KINECT_V2, FLOOR_MM, side))
    np.testing.assert_allclose(area, 1000.0 * ((FLOOR_MM - 20.0) / 365.0) ** 2, rtol=0.02)
    assert round(1000.0 * (FLOOR_MM / 365.0) ** 2) == 3401, "at the floor's own depth"


def test_6_a_length_does_not_depend_on_the_way_the_animal_faces(tmp_path: Path) -> None:
    """Pixels that are not square: an axis has its own scale, whichever way the animal lies
    in it.
    """
    oblong = Camera(300.0, 400.0, 159.5, 159.5, 320, 320)
    turned = [Plate(600.0, 80.0, 20.0, (10.0, 10.0), turn) for turn in np.linspace(0.1, 1.5, 7)]
    _, sides, _ = measured(tmp_path / "r", oblong, turned)
    np.testing.assert_allclose(sides, 80.0, rtol=0.01)


def test_7_a_speed_is_per_second_and_a_lost_frame_does_not_double_it() -> None:
    """5 mm a frame at 30 frames/s with one frame lost: 150 mm/s before, across and after, not 10 mm
    in a frame.
    """
    moved = kinematics(
        *tables_of(WalkingMouse(np.delete(steady(2.0), 30), speed_mm_s=150.0, radius_mm=1e5))
    )
    known = moved["speed_mm_s"].dropna()
    assert len(known) >= len(moved) - 2, (
        "but for the frames beside the gap, across which nothing is measured"
    )
    np.testing.assert_allclose(known, 150.0, rtol=1e-3)


def test_8_the_speed_does_not_begin_anew_with_every_chunk(tmp_path: Path) -> None:
    mouse = WalkingMouse(steady(3.0), speed_mm_s=150.0, radius_mm=300.0)
    few, many = (write(tmp_path / f"{chunk}.liex", mouse, chunk) for chunk in (7, 90))
    np.testing.assert_allclose(few.kinematics["speed_mm_s"], 150.0, rtol=2e-3)
    assert few.kinematics["speed_mm_s"].tolist() == many.kinematics["speed_mm_s"].tolist()


def test_9_an_angular_velocity_is_how_fast_it_turns_and_not_where_it_goes() -> None:
    moved = kinematics(*tables_of(WalkingMouse(steady(1.0), speed_mm_s=150.0, radius_mm=1e7)))
    np.testing.assert_allclose(moved["yaw_rate_rad_s"], 0.0, atol=1e-3)
    np.testing.assert_allclose(moved["heading_rad"], np.pi / 2, atol=1e-3)


def test_10_a_vertical_speed_is_of_a_named_point_in_mm_a_second() -> None:
    moved = kinematics(*tables_of(WalkingMouse(steady(3.0), speed_mm_s=1e-6, rear_s=(1.0, 2.0))))
    rise = moved["z_mm"].max() - moved["z_mm"].iloc[0]
    up = moved["vertical_speed_mm_s"].clip(lower=0).sum() / 30.0
    assert up == pytest.approx(rise, rel=0.05)
    assert rise > 10.0


def test_11_times_have_one_unit_whatever_file_they_come_from(tmp_path: Path) -> None:
    """Milliseconds in depth_ts.txt, seconds and nanoseconds in a timestamps.csv: the same duration
    from all three.
    """
    stored, times = depth_frames(31), even_times(31, step_ns=33_000_000)
    milliseconds = write_moseq_folder(tmp_path / "m", stored, [f"{t / 1e6:.6f}" for t in times])
    (milliseconds / "camera.toml").write_text("fx = 60.0\nfy = 61.0\ncx = 31.5\ncy = 23.5\n")
    nanoseconds = write_png_folder(tmp_path / "n", stored, times_ns=times)
    seconds = write_png_folder(tmp_path / "s", stored)
    (seconds / "timestamps.csv").write_text("time_s\n" + "".join(f"{t / 1e9:.9f}\n" for t in times))
    for path in (milliseconds, nanoseconds, seconds):
        with open_recording(path) as recording:
            assert recording.duration_s == pytest.approx(0.99, abs=1e-6)
            assert recording.rate_hz == pytest.approx(1000 / 33, rel=1e-5)


@pytest.mark.parametrize(
    ("rate", "lost", "missing"), [(60.0, (), 0), (30.0, (11, 30, 31, 77), 4), (200.0, (9,), 1)]
)
def test_12_lost_frames_are_counted_at_any_rate(
    tmp_path: Path, rate: float, lost: tuple[int, ...], missing: int
) -> None:
    """No rate is expected of a camera: 60 frames/s are not a hundred per cent lost, and 4 lost of
    100 are seen.
    """
    times = [int(k * 1e9 / rate) for k in range(100) if k not in lost]
    findings = examine(write_png_folder(tmp_path / "r", depth_frames(len(times)), times_ns=times))
    assert findings["n_frames"] == 100 - len(lost)
    assert findings["n_missing"] == missing
    assert findings["rate_hz"] == pytest.approx(rate, rel=1e-3)


def test_14_the_model_sees_in_use_what_it_saw_in_training() -> None:
    """One picture through both doors, the one for training windows and the one for recordings: the
    same height map.
    """
    plate = Plate(600.0, 60.0, 25.0, (20.0, -10.0))
    picture = np.rint(plate.depth(PRIMESENSE_QVGA)).astype(np.uint16)
    bare = np.full_like(picture, 600)
    floor = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 600.0, PRIMESENSE_QVGA)
    scene = replace(bare_floor(PRIMESENSE_QVGA, floor), area_mm2=3600.0)
    used = scene.extract(picture[None].astype(np.float32), 1.0)
    lens = np.array(
        [[PRIMESENSE_QVGA.fx, PRIMESENSE_QVGA.fy, PRIMESENSE_QVGA.cx, PRIMESENSE_QVGA.cy]]
    )
    windows = Patches(picture[None], bare[None], lens, np.zeros((1, 2)), floor.inverse_depth[None])
    trained, _ = windows.extract(np.ones(1), np.array([3600.0]))
    assert used.found.all()
    np.testing.assert_array_equal(used.heights, trained.heights)
    np.testing.assert_array_equal(used.origin, trained.origin)
    np.testing.assert_allclose(used.moments, trained.moments, atol=1e-9)
