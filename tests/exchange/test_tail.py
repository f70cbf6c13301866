"""A tail on a noisy floor is found with its direction, and a bare floor shows none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from liex_lab.exchange import tail
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera

CAMERA = Camera(365.0, 365.0, 100.0, 100.0, 200, 200)
ABOVE = SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 600.0]))
N = 12
BASE = np.tile([5.0, -8.0, 15.0], (N, 1))
HEADING = np.tile([np.cos(0.5), np.sin(0.5)], (N, 1))


def searched(monkeypatch, turn_deg: float | None, kept: bool = True) -> tail.Tail:
    """What is found behind a rump where a tail 4 mm wide and 4 mm high lies, or none."""
    rng = np.random.default_rng(5)
    still = np.full((200, 200), 600, np.uint16)
    floor = ABOVE @ CAMERA.unproject(
        np.moveaxis(np.mgrid[:200, :200][::-1], 0, -1).astype(float), still.astype(float)
    )
    frames = []
    for k in range(N):
        height = rng.normal(0.0, 1.5, still.shape)
        if turn_deg is not None:
            yaw = 0.5 + np.pi - np.radians(turn_deg)  # of the tail, to the animal's left
            along, across = np.moveaxis(
                (floor[..., :2] - BASE[k, :2])
                @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]),
                -1,
                0,
            )
            height += 4.0 * ((np.abs(across) < 2.0) & (along > 0.0) & (along < 40.0))
        frames.append(SimpleNamespace(index=k, depth=np.rint(still - height).astype(np.uint16)))
    recording = SimpleNamespace(chunks=lambda n: [frames])
    everywhere = SimpleNamespace(holds=lambda row, u, v: np.ones(u.shape, bool))
    monkeypatch.setattr(tail, "open_depth", lambda session: recording)
    monkeypatch.setattr(tail, "still_scene", lambda recording: still)
    monkeypatch.setattr(tail, "Kept", lambda session: everywhere)
    monkeypatch.setattr(tail, "meant_to_keep_depth", lambda session: kept)
    times = pd.DataFrame({"time_s": np.arange(N) / 30.0})
    session: Any = SimpleNamespace(frames=times, camera=CAMERA, T_arena_camera=ABOVE)
    return tail.find_tail(session, BASE, np.ones((N, 3)), 2.0 * HEADING)


@pytest.mark.parametrize("turn_deg", [-60.0, 0.0, 35.0])
def test_a_tail_is_found_where_it_lies(monkeypatch, turn_deg):
    found = searched(monkeypatch, turn_deg)
    np.testing.assert_allclose(np.degrees(found.turn), turn_deg, atol=10.0)
    assert (found.probability > 0.9).all()
    yaw = 0.5 + np.pi - np.radians(turn_deg)
    place = BASE[:, :2] + 30.0 * np.array([np.cos(yaw), np.sin(yaw)])
    assert np.linalg.norm(found.xyz_mm[:, :2] - place, axis=1).max() < 5.5
    assert abs(np.median(found.xyz_mm[:, 2]) - 3.0) < 1.5
    assert (found.sd_mm[:, 0] < 6.0).all()
    np.testing.assert_allclose(
        np.tan(found.lift), (found.xyz_mm[:, 2] - BASE[:, 2]) / 30.0, atol=1e-9
    )


def test_a_bare_floor_shows_no_tail_and_a_session_without_depth_nothing(monkeypatch):
    found = searched(monkeypatch, None)
    assert np.median(found.probability) < 0.6
    assert np.median(found.sd_mm[:, 0]) > 15.0
    unseen = searched(monkeypatch, 0.0, kept=False)
    assert np.isnan([unseen.turn, unseen.lift, unseen.probability, unseen.xyz_mm[:, 0]]).all()
