"""Scenes: the same seed is the same picture, the truth lies in it, each scene is what it says."""

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.recordings import open_recording
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.catalogue import SCENES, SEALED_FROM, film
from liex_lab.simulation.scenes.stage import timing_of
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR

SEED = 41
N = 12


def mice(name: str, n_frames: int = N, **settings: float) -> RenderedRecording:
    made = film(name, SEED, n_frames, sensor=PRIMESENSE_QVGA_SENSOR, **settings)  # type: ignore[arg-type]
    assert isinstance(made, RenderedRecording)
    return made


def heights(recording: RenderedRecording, frame: int) -> np.ndarray:
    """Height of every pixel above the true floor, mm; NaN where unread."""
    depth = recording.depths(frame, frame + 1)[0].astype(float)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    points = recording.camera.unproject(np.stack([u, v], axis=-1), depth)
    z = (recording.T_arena_camera @ points)[..., 2]
    return np.asarray(np.where(depth > 0, z, np.nan))


@pytest.mark.parametrize("name", ["bedding", "drift"])
def test_a_scene_is_the_same_whenever_and_in_whatever_order_it_is_read(name: str) -> None:
    n = 14  # epochs of bedding are 12 frames
    first, again = (mice(name, n) for _ in range(2))
    backwards = [again.depths(i, i + 1)[0] for i in range(n - 1, -1, -1)][::-1]
    np.testing.assert_array_equal(first.depths(0, n), np.stack(backwards))
    np.testing.assert_array_equal(
        np.stack([frame.depth for chunk in first.chunks(5) for frame in chunk]), first.depths(0, n)
    )


QUICK = ("plain", "late", "object", "house", "cage", "glossy", "bedding", "two-arenas")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.nightly)
        for name, (plan, _) in SCENES.items()
        if plan == "mouse"
    ],
)
def test_the_animals_stand_where_the_truth_says(name: str) -> None:
    # long enough for a hand that brings an animal to be gone
    n = 30 if name in ("late", "leaves", "object", "object-out") else 4
    recording = mice(name, n)
    assert len(recording) == n
    for animal in recording.animals:
        frame = int(np.argmax(animal.visible))
        assert animal.visible[frame] > 0.6
        uv = recording.camera.project(animal.joints_camera[frame]).round().astype(int)
        back = heights(recording, frame)[uv[1:4, 1], uv[1:4, 0]]
        assert np.nanmedian(back) > 8.0, "the trunk stands above the floor where the joints are"
    if name == "late":
        (animal,) = recording.animals
        assert np.isnan(animal.joints_camera[:20]).all()
        assert np.isfinite(animal.joints_camera[20:]).all()
        assert not animal.visible[:20].any()


def test_scenes_of_one_seed_have_the_same_animal() -> None:
    plain, raised = mice("plain"), mice("raised")
    assert plain.spine_mm == raised.spine_mm
    np.testing.assert_array_equal(plain.pose.angles, raised.pose.angles)
    assert plain.spine_mm != film("plain", SEED + 1, N).spine_mm


def test_cameras_and_arenas_are_as_their_scenes_say() -> None:
    high = heights(mice("raised", 1), 0)
    assert (np.abs(high + 480.0) < 25.0).mean() > 0.2  # the room's floor far below
    assert 0.05 < (np.abs(high) < 15.0).mean() < 0.5
    recording = film("small", SEED, 1)
    high = heights(recording, 0)
    v, u = np.mgrid[: high.shape[0], : high.shape[1]]
    across = np.hypot(u - recording.camera.cx, v - recording.camera.cy) < 130
    assert 0.10 < (across & (np.abs(high) < 12.0)).mean() < 0.20
    axis = mice("tilted", 1).T_arena_camera.rotation[:, 2]
    assert np.degrees(np.arccos(-axis[2])) == pytest.approx(35.0)


def test_bedding_changes_where_the_animal_walks_and_lifts_it() -> None:
    recording = mice("bedding", 36)
    stills = recording.stage.stills
    assert stills is not None
    assert len(stills) == 3
    changed = np.abs(stills[-1] - stills[0])
    assert 0.0 < (changed > 2.0).mean() < 0.3
    flat = mice("plain", 36)
    rump, level = (r.joints_arena[:, 0, 2] for r in (recording, flat))
    assert (rump - level).min() > 0.5


@pytest.mark.nightly
def test_a_mouse_in_its_house_is_hidden() -> None:
    recording = mice("house", 120)
    seen = recording.animals[0].visible
    assert (seen[:20] > 0.5).any()
    assert 0.1 < (seen < 0.1).mean() < 0.7
    hidden = int(np.argmin(seen))
    above = heights(recording, hidden)
    uv = recording.camera.project(recording.joints_camera[hidden]).round().astype(int)
    assert np.nanmedian(above[uv[:, 1], uv[:, 0]]) == pytest.approx(66.0, abs=6.0)  # its roof


def test_a_tether_reaches_from_the_head_to_the_commutator() -> None:
    recording = mice("tether")
    cable = recording.stage.objects[1].vertices()
    head = recording.joints_arena[:, -2:].mean(axis=1)
    assert (np.linalg.norm(cable[:, 0] - head, axis=-1) < 30.0).all()
    np.testing.assert_allclose(cable[:, -1], np.broadcast_to(cable[0, -1], (N, 3)), atol=12.0)
    assert cable[0, -1, 2] > 200.0


def test_a_sensor_that_warms_up_reads_more_and_more() -> None:
    drifting, steady = mice("drift", 40), mice("plain", 40)
    shift = np.nanmedian(
        drifting.depths(39, 40)[0].astype(float) - steady.depths(39, 40)[0].astype(float)
    )
    assert 3.0 < shift < 6.0
    np.testing.assert_array_equal(drifting.depths(0, 1), steady.depths(0, 1))


@pytest.mark.parametrize(
    ("presence", "share", "rest"),
    [
        ("always", 1.0, 0.0),
        ("asleep", 1.0, 0.78),
        ("still", 1.0, 1.0),
        ("late", 1 / 3, 0.0),
        ("leaves", 0.45, 0.0),
        ("never", 0.0, 0.0),
    ],
)
def test_animals_are_there_and_move_as_long_as_they_should(
    presence: str, share: float, rest: float
) -> None:
    moments, there = timing_of(presence, 300)
    resting = (np.diff(moments) == 0)[there[1:]].mean() if there.any() else 0.0
    assert there.mean() == pytest.approx(share, abs=0.01)
    assert resting == pytest.approx(rest, abs=0.02)


def test_two_animals_keep_apart_and_an_empty_arena_has_none() -> None:
    first, second = mice("two-animals").animals
    gap = np.linalg.norm(
        first.joints_camera.mean(axis=1) - second.joints_camera.mean(axis=1), axis=-1
    )
    assert gap.min() > 25.0
    assert mice("empty").animals == ()
    assert len(mice("four-arenas").animals) == 4


def test_a_mirrored_hand_is_the_hand_with_left_and_right_exchanged() -> None:
    hand, mirrored = (film(name, SEED, 2) for name in ("hand", "mirrored-hand"))
    np.testing.assert_array_equal(mirrored.depths(0, 2), hand.depths(0, 2)[..., ::-1])
    ours = mirrored.camera.project(mirrored.joints_camera)
    theirs = hand.camera.project(hand.joints_camera)
    np.testing.assert_allclose(ours[..., 0], hand.width - 1 - theirs[..., 0])
    np.testing.assert_allclose(ours[..., 1], theirs[..., 1])


# addresses


def test_a_scene_is_a_recording_by_its_address() -> None:
    address = f"synthetic:scene?name=raised&seed={SEED}&frames=3&sensor=primesense-qvga"
    recording = open_recording(address)
    assert isinstance(recording, RenderedRecording)
    assert (recording.name, len(recording)) == (f"scene-raised-{SEED}", 3)
    np.testing.assert_array_equal(recording.frame(1).depth, mice("raised", 3).depths(1, 2)[0])
    with pytest.raises(RecordingError, match="there is no scene 'moon'"):
        film("moon", 0, 1)


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("synthetic:scene?name=raise", "nearest one is raised"),
        ("synthetic:scene?name=fish&sensor=kinect-v2", "sensor is no setting"),
        ("synthetic:scene?build=rat", "one of other, train"),
        ("synthetic:scene?frames=30000", "from 1 to 20000"),
        (f"synthetic:scene?seed={SEALED_FROM}", "are kept for"),
    ],
)
def test_a_slip_in_a_scenes_address_is_told(address: str, says: str) -> None:
    with pytest.raises(RecordingError, match=says):
        open_recording(address)
