"""Whom a track is of."""

from __future__ import annotations

from dataclasses import dataclass

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera


@dataclass(frozen=True)
class Subject:
    """Whom a track is of, before which camera, and by which limits its rows are kept or flagged.

    Attributes:
        skeleton: kinematic tree of the animal.
        camera: the depth camera that took the recording.
        T_arena_camera: pose of the camera in the arena frame, mm.
        length_mm: spine length of this animal, mm.
        doubtful_mm: frames with a larger predicted mean joint error, mm, are flagged.
        bridge_s: so long a gap without a measurement is bridged, s, and half as far into a longer
            one from both its ends.
        joint_share: (J,) error of each joint over the mean of all joints.
        stretch_sd: standard deviation of the share by which all distances from the base may be off
            throughout, for an animal whose ends a sensor eats is taken for a smaller one; None
            where nothing is known of it, which takes the usual share of `Motion`.
        unseen: standard deviations over the length of the joints' height and of their place along
            the body that a session's own shape leaves; None without one, which takes those of
            `Motion`.
        n_animals: how many animals are in view at once, one of which is followed.
    """

    skeleton: Skeleton
    camera: Camera
    T_arena_camera: SE3
    length_mm: float
    doubtful_mm: float
    bridge_s: float
    joint_share: tuple[float, ...]
    stretch_sd: float | None = None
    unseen: tuple[float, float] | None = None
    n_animals: int = 1
