"""Tracks made of formulas: a mouse or a fish that goes and stays by turns."""

from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np

from liex_lab.actions import learning
from liex_lab.actions.ethogram import UNLABELLED
from liex_lab.actions.labels import LabelledTrack
from liex_lab.actions.learning import learn
from liex_lab.actions.timeline import TimelineModel
from liex_lab.actions.vocabulary import DEFINITIONS
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.tracking.track import Track

GO, STAY = "go", "stay"


def straight_track(
    animal: str, times_s: np.ndarray, way_mm: np.ndarray, heading_rad: np.ndarray | float = 0.3
) -> Track:
    """A straight body that has come way_mm (n,) along its headings."""
    skeleton, n = Skeleton.load(animal), len(times_s)
    heading = np.broadcast_to(np.asarray(heading_rad, float), (n,))
    steps = np.diff(way_mm, prepend=way_mm[0])[:, None] * np.stack(
        [np.cos(heading), np.sin(heading), 0 * heading], 1
    )
    rotation = so3.exp(np.stack([0 * heading, 0 * heading, heading], axis=1))
    track = Track.empty(skeleton, np.round(times_s * 1e9).astype(np.int64), "")
    place = np.cumsum(steps, axis=0) + np.array([0.0, 0.0, 12.0])
    pose = Pose(SE3(rotation, place), np.zeros((n, skeleton.n_joints, 3)), np.ones(n))
    track.joints_mm[:], track.root_rotation[:], track.root_mm[:] = (
        pose.joints(skeleton),
        rotation,
        place,
    )
    track.angles_rad[:], track.scale[:], track.sd_mm[:] = 0.0, 1.0, 1.0
    track.sd_xy_mm[:] = track.sd_z_mm[:] = 1.0
    track.predicted_error_mm[:] = 2.0
    return track


def going_and_staying(
    seed: int, rate_hz: float = 30.0, seconds: float = 40.0, animal: str = "mouse"
) -> LabelledTrack:
    """It goes at 3 lengths a second for a second or so, then stays as long; labelled, with a little
    noise.
    """
    rng = np.random.default_rng(seed)
    clock = np.arange(0.0, seconds, 1.0 / rate_hz)
    edges = np.cumsum(rng.uniform(0.8, 2.0, int(seconds)))
    going = np.searchsorted(edges, clock) % 2 == 0
    length = Skeleton.load(animal).length
    track = straight_track(
        animal, clock, np.cumsum(np.where(going, 3.0 * length, 0.0)) / rate_hz, 0.4 * np.sin(clock)
    )
    track.joints_mm[:] += rng.normal(0.0, 0.3, track.joints_mm.shape)
    words, wall_mm = np.where(going, GO, STAY), np.full(len(going), np.nan)
    return LabelledTrack(track, words, f"{animal}-{seed}", wall_mm)


def few_steps() -> AbstractContextManager[object]:
    """Training in a fifth of the usual steps, which is enough for these tracks."""
    return patch.object(learning, "_LEAST_STEPS", 300)


@cache
def trained() -> TimelineModel:
    """A recogniser that names going and staying, trained once per run."""
    tracks = [going_and_staying(seed, seconds=16.0) for seed in range(3)]
    with few_steps():
        return learn(tracks, seed=1, definitions={GO: "goes", STAY: "stays"})


def taught_to_lie() -> TimelineModel:
    """The same, but it calls going a pause, and staying a freeze."""
    assert trained().words == (UNLABELLED, GO, STAY)
    words = (UNLABELLED, "pause", "freeze")
    return replace(trained(), words=words, definitions=DEFINITIONS["mouse"])
