"""What every row of the tables is given alike: background, choice of object, and animal's size.

Lie-X assumes one object in the picture and a skeleton of "proper scaling" (sections 3 and 4), so
which of two objects is the animal, and how large it is, must not tell the methods apart. Our
default estimator chooses for all; every row measures the component that it chose. `wrong` says in
which frames that component was another object, and `wrong_alone` the same for the choice by area
and volume that the paper's variant and the baselines would have made by themselves. A component is
another object where its centroid is farther from the middle of the true joints than 0.8 spines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...build import build_scene

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.plan import Plan
    from liex_lab.scene.height_maps import HeightMaps
    from liex_lab.scene.segmenter import Segmenter
    from liex_lab.simulation.recording import TrueRecording

Array = NDArray[np.float64]

_OTHER = 0.8  # of the spine: the centroid of what is farther off is that of another object


@dataclass(frozen=True)
class CommonView:
    """What is given to every row in the n frames of one recording.

    Attributes:
        size: the animal's spine over home size, as the default estimator finds it.
        second: (n,) bool, the second of two components is measured.
        wrong: (n,) bool, the component that is measured is another object.
        wrong_alone: (n,) bool, so would be that of the choice by area and volume.
    """

    size: float
    second: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    wrong_alone: NDArray[np.bool_]


def common_view(
    recording: TrueRecording, plan: Plan, chooser: PoseEstimator
) -> tuple[Segmenter, NDArray[np.float32], CommonView]:
    """Handle a recording as `liex run` would, up to the pose.

    Args:
        recording: a rendered recording with its truth.
        plan: thresholds of the foreground, and expected sizes.
        chooser: finds the animal's size, and which of two components it is.

    Returns:
        The fitted segmenter, all frames (n, H, W) mm, and what every row is given.
    """
    from liex_lab.baselines.baseline import chosen, second_is_likelier

    scene, frames = build_scene(recording, plan, chooser.skeleton, len(recording))
    size = chooser.find_size(frames, scene)
    second = chooser.second_is_animal(frames, scene, size)
    crops, crop_cameras = chosen(frames, scene, 1.0, second, True)
    wrong = is_other(crops, crop_cameras, recording)
    alone = second_is_likelier(frames, scene)
    wrong_alone = is_other(*chosen(frames, scene, 1.0, alone, True), recording)
    return scene, frames, CommonView(size, second, wrong, wrong_alone)


def is_other(crops: HeightMaps, crop_cameras: Array, recording: TrueRecording) -> NDArray[np.bool_]:
    """Whether (n,) a component is another object than the animal, by its centroid.

    Args:
        crops: height maps of the n frames, along the optical axis.
        crop_cameras: (n, 17) their crop cameras.
        recording: the recording with its truth.
    """
    from liex_lab.geometry import SE3
    from liex_lab.scene.height_maps import view_of

    T = view_of(crop_cameras)
    joints = SE3(T.rotation[:, None], T.translation[:, None]) @ recording.joints_camera
    blob = crops.blobs
    centroid = np.stack(
        [blob.x, blob.y, blob.volume_mm3 / np.maximum(blob.area_mm2, 1e-9)], axis=-1
    )
    off = np.linalg.norm(centroid - joints.mean(axis=1), axis=-1)
    return np.asarray(crops.found & (off > _OTHER * recording.spine_mm))


def measured(
    subject: PoseEstimator | Baseline,
    frames: NDArray[np.float32],
    scene: Segmenter,
    view: CommonView,
    cut: dict[tuple[float, bool], tuple[HeightMaps, Array]],
) -> tuple[Array, Array, Array]:
    """Joints, predicted errors and their interval of one subject on the common choice of object.

    Args:
        subject: an estimator or a baseline.
        frames: (n, H, W) float32 depth, mm, 0 where unread.
        scene: the fitted segmenter.
        view: what every row is given.
        cut: height maps that other subjects measured already, by size and view; filled.

    Returns:
        As `pose.measure`: joints (n, J, 3) mm, camera frame; predicted error (n,) mm; factors (2,).
    """
    from liex_lab.baselines.baseline import chosen
    from liex_lab.estimation.estimator import PoseEstimator

    if isinstance(subject, PoseEstimator):
        sized = subject.model.method.session_size
        camera_view = subject.model.method.camera_view
    else:
        sized = subject.takes_size
        camera_view = True
    key = (view.size if sized else 1.0, camera_view)
    if key not in cut:
        cut[key] = chosen(frames, scene, key[0], view.second, camera_view)
    crops, crop_cameras = cut[key]
    if not isinstance(subject, PoseEstimator):
        joints = subject.guesses(crops, crop_cameras, key[0]).joints
        return joints, np.full(len(frames), np.nan), np.full(2, np.nan)
    found = subject.best_of(crops, crop_cameras, key[0])
    return (
        found.chosen.pose.joints(subject.skeleton),
        found.chosen.error_mm,
        np.array(subject.model.calibration.quantiles),
    )
