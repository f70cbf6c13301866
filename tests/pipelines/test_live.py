"""Frames that are still to come: through a socket, and out of a folder that grows."""

import socket
import threading
import time

import numpy as np
import pytest
from liex_lab.pipelines.evaluation.live import evaluate_live
from liex_lab.pipelines.live import open_live, track_live

from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.streaming import growing, received, replayed
from liex_lab.simulation.scenes.catalogue import film

ADDRESS = "synthetic:walk?seed=3&frames=24&sensor=primesense-qvga&spine_mm=70"
PLAN = Plan.load("mouse").with_settings(["animal.spine_mm=70"])


def test_skeletons_are_told_as_frames_come_and_the_whole_track_at_the_end():
    shown: list[tuple[int, bool]] = []
    closed = []

    class View:
        def show(self, frame, rows):
            shown.append((frame.index, bool(rows[0].posed[0])))

        def close(self):
            closed.append(True)

    # long enough that the mouse leaves the place where it stood when the background was learned
    arriving = open_live(
        "synthetic:walk?seed=3&frames=48&sensor=kinect-v2&spine_mm=70", PLAN, replay=True
    )
    numbers, (tracked,) = track_live(arriving, PLAN, learn_frames=36, viewer=lambda *_: View())
    assert closed == [True]
    assert [index for index, _ in shown] == list(range(48))
    assert sum(posed for _, posed in shown) >= 44
    assert tracked.track.n_frames == numbers["n_frames"] == 48
    assert numbers["n_measured"] >= 44
    assert 0 <= numbers["n_live"] <= 48


def test_two_animals_are_followed_at_once_and_each_in_its_place():
    scene = film("two-animals", 3, 60)
    plan = Plan.load("mouse").with_settings(["animal.count=auto"])
    numbers, tracks = track_live(replayed(scene, 1000.0), plan, learn_frames=40)
    assert (numbers["n_animals"], numbers["n_frames"], numbers["n_unclear"]) == (2, 60, 0)
    truth = [scene.camera.project(one.joints_camera).mean(axis=1) for one in scene.animals]
    nearest = []
    for one in tracks:
        assert (one.track.flag == "").mean() > 0.7
        middle = one.track.uv_px.mean(axis=1)
        off = [np.nanmedian(np.linalg.norm(middle - place, axis=1)) for place in truth]
        assert min(off) < 10.0
        nearest.append(int(np.argmin(off)))
    assert sorted(nearest) == [0, 1]


def test_a_recording_that_grows_is_read_as_it_grows_and_over_when_nothing_comes():
    whole = open_recording(ADDRESS)
    there = [3]

    def reopen() -> Recording:
        n = there[0]
        return Recording(
            name="growing",
            format="test",
            camera=whole.camera,
            times_ns=whole.times_ns[:n],
            read=lambda index: whole.frame(index).depth,
        )

    def write() -> None:
        for n in (5, 9, 12):
            time.sleep(0.1)
            there[0] = n

    thread = threading.Thread(target=write)
    thread.start()
    came = [arrival.frame.index for arrival in growing(reopen, patience_s=1.5).frames]
    thread.join()
    assert came == list(range(12))


def test_where_nobody_sends_or_writes_that_is_said():
    with pytest.raises(RecordingError, match="no sender answers"):
        received("127.0.0.1", 9)

    def nothing() -> Recording:
        raise RecordingError("there is no such file")

    with pytest.raises(RecordingError, match="no such file"):
        growing(nothing, patience_s=0.1)


def test_what_does_not_greet_as_a_sender_does_is_told_apart():
    server = socket.create_server(("127.0.0.1", 0))

    def hang_up() -> None:
        with server, server.accept()[0] as link:
            link.sendall(b"HTTP/1.1 400 Bad Request")

    thread = threading.Thread(target=hang_up)
    thread.start()
    with pytest.raises(RecordingError, match="does not send depth frames"):
        received("127.0.0.1", server.getsockname()[1])
    thread.join()


def test_a_first_frame_that_is_long_in_the_making_ends_nothing(monkeypatch):
    monkeypatch.setattr("liex_lab.recordings.streaming._GREETING_S", 0.2)
    whole = open_recording(ADDRESS)

    def read(index: int) -> np.ndarray:
        if index == 0:
            time.sleep(0.5)
        return whole.frame(index).depth

    slow = Recording(
        name="slow",
        format="test",
        camera=whole.camera,
        times_ns=whole.times_ns[:5].copy(),
        read=read,
    )
    came = list(replayed(slow, speed=4.0).frames)
    assert [arrival.frame.time_ns for arrival in came] == slow.times_ns.tolist()
    np.testing.assert_array_equal(came[3].frame.depth, whole.frame(3).depth)
    assert came[-1].at_s - came[0].at_s > 0.8 * slow.duration_s / 4.0, "nor is its pace lost"


@pytest.mark.nightly  # at the pace of the cameras
def test_cameras_that_film_at_once_have_an_animal_each_and_the_pace_that_is_asked_for():
    told = evaluate_live("mouse", n_frames=200, rate_hz=60.0, n_cameras=2)
    assert told["rate_hz"] == pytest.approx(60.0, rel=1e-6)
    assert told["cameras"]["n_frames"] == [200, 200]
    assert min(told["cameras"]["n_measured"]) > 150
    late = [ms for ms in told["cameras"]["latency_p95_ms"] if ms is not None]
    assert told["latency_p95_ms"] == max(late, default=None)
