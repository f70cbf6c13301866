"""Depth images that repeat: asked for too often, a stream that froze, or an animal at rest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import has_noise
from liex_lab.tracking.curve import polled_twice, repeat_messages, track_whole
from tests.recordings.writers import SMALL
from tests.tracking.stories import SUBJECT, joint_error, noisy, told, walk

FLOOR = np.full((48, 64), 600.0, np.float32)


@settings(max_examples=15)
@given(st.lists(st.integers(0, 2), min_size=1, max_size=20), st.integers(0, 19), st.integers(1, 6))
def test_a_frame_repeats_where_it_equals_the_one_before_however_it_is_read(
    values: list[int], first: int, n: int
) -> None:
    """Value 0 is a wholly unread image, which repeats nothing."""
    images = [np.full((48, 64), 600.0 * value, np.float32) for value in values]
    recording = Recording(
        name="r",
        format="toy",
        camera=SMALL,
        times_ns=np.arange(len(values)),
        read=lambda row: images[row].copy(),
    )
    by_hand = [k > 0 and values[k] == values[k - 1] != 0 for k in range(len(values))]
    assert [frame.repeats for frame in recording] == by_hand
    assert [frame.repeats for frame in recording.frames(first)] == by_hand[first:]
    read = [frame.repeats for chunk in recording.chunks(n, first) for frame in chunk]
    assert read == by_hand[first:]
    assert [f.index for f in recording.frames(first)] == [*range(len(values))][first:]


def scene(kind: str, n: int = 40) -> np.ndarray:
    """Images with an animal that walks along; what else differs from one to the next is `kind`."""
    rng = np.random.default_rng(5)
    images = np.tile(FLOOR, (n, 1, 1))
    for k in range(n):
        images[k, 20:28, k : k + 12] = 570.0 + rng.integers(0, 4, (8, 12))
    noise = np.round(rng.normal(0.0, 0.7, images.shape))
    if kind == "one pixel in twelve flickers":
        noise *= rng.random(images.shape) < 1 / 6
    if kind == "no noise" or kind == "8 bits without noise":
        noise *= 0
    images += noise.astype(np.float32)
    if kind == "8 bits without noise":
        images = np.round(images / 8.0) * np.float32(8.0)
    if kind == "half of it frozen":
        images[n // 2 :] = images[n // 2]
    if kind == "noise in a region":
        images[:, :, :24] = images[:, 30:] = 0
    if kind == "nothing":
        images[:] = FLOOR
    if kind == "unread":
        images[:] = 0
    return images


@pytest.mark.parametrize(
    ("kind", "noise"),
    [
        ("noise", True),
        ("one pixel in twelve flickers", True),
        ("half of it frozen", True),
        ("noise in a region", True),
        ("no noise", False),
        ("8 bits without noise", False),
        ("nothing", False),
        ("unread", False),
    ],
)
def test_a_sensor_has_noise_where_everything_changes_not_the_animal_alone(
    kind: str, noise: bool
) -> None:
    assert has_noise(scene(kind)) == noise


def polled(camera_hz: float, asked_hz: float, n: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) ns of a program that asks, and whether it got the same image again."""
    times_s = np.arange(n) / asked_hz
    image = np.floor(times_s * camera_hz + 1e-6)
    return np.round(1e9 * times_s).astype(np.int64), np.append(False, np.diff(image) == 0)


@pytest.mark.parametrize(
    ("camera_hz", "asked_hz", "times"),
    [(30, 60, "twice"), (30, 50, "1.7 times"), (15, 30, "twice"), (30, 90, "3 times"),
     (30, 45, "1.5 times"), (15, 60, "4 times")],
)  # fmt: skip
def test_asking_too_often_is_reported_with_the_cameras_own_rate(
    camera_hz: float, asked_hz: float, times: str
) -> None:
    times_ns, repeats = polled(camera_hz, asked_hz)
    assert (polled_twice(times_ns, repeats, ~repeats) == repeats).all()
    assert repeat_messages(times_ns, repeats, noisy=True) == (
        [],
        [
            f"each depth image is there {times}: the camera made {camera_hz}.00 frames/s, not "
            f"{asked_hz}.00; each image counts once"
        ],
    )


@given(st.integers(1, 60), st.integers(2, 100), st.booleans())
def test_a_freeze_is_told_from_asking_too_often(n_frozen: int, at: int, twice: bool) -> None:
    times_ns, repeats = polled(30, 60 if twice else 30)
    frozen = slice(2 * at, min(2 * at + n_frozen, len(times_ns)))
    repeats = repeats.copy()
    repeats[frozen] = True
    often = polled_twice(times_ns, repeats, ~repeats)
    alone = ~often & repeats
    if n_frozen > 1 or not twice:
        assert alone[frozen].all()
        reasons, cautions = repeat_messages(times_ns, repeats, noisy=True)
        assert bool(reasons) == (alone.sum() > 24)
        assert any("the stream froze" in one for one in [*reasons, *cautions])
    assert not alone[: frozen.start - 1].any()
    assert not alone[frozen.stop + 1 :].any()


def test_without_noise_a_still_animal_is_noted_and_nothing_is_taken_from_it() -> None:
    times_ns, repeats = polled(30, 60)
    reasons, cautions = repeat_messages(times_ns, repeats, noisy=False)
    assert not reasons
    assert "the background has no noise" in cautions[0]
    assert repeat_messages(times_ns[:9], repeats[:9], noisy=False) == ([], [])


def test_copies_do_not_make_a_track_surer_and_a_freeze_has_no_pose() -> None:
    seconds = np.arange(0, 4, 1 / 30)
    truth = walk(seconds)
    measured = told(seconds, noisy(truth, np.random.default_rng(5)))
    once = track_whole(SUBJECT, measured).track
    rows = np.repeat(np.arange(len(seconds)), 2)
    times = np.round(1e9 * np.arange(len(rows)) / 60).astype(np.int64)
    columns = {name: getattr(measured, name)[rows] for name in measured.__dataclass_fields__
               if name not in ("skeleton", "times_ns")}  # fmt: skip
    seen = type(measured)(measured.skeleton, times_ns=times, **columns)
    seen.repeats[1::2] = True
    seen.forget(seen.repeats)
    track = track_whole(SUBJECT, seen).track
    assert (track.flag[1::2] == "repeated").all()
    assert track.observed.all()
    assert np.median(track.predicted_error_mm) > 0.97 * np.median(once.predicted_error_mm)
    assert joint_error(track.joints_mm, walk(times * 1e-9)).max() < 5.0
    assert (track.n_foreground_px > 0).all()
    seen.repeats[80:120] = True
    seen.forget(seen.repeats)
    track = track_whole(SUBJECT, seen).track
    assert not track.posed[80:120].any()
    assert not track.bridged[80:120].any()
    assert track.observed[:79].all()
    assert track.observed[121:].all()
