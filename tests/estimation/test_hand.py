"""The bundled hand: somebody's gestures before a camera, from the pictures alone."""

import numpy as np

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.scene.hand_segmenter import HandSegmenter
from liex_lab.simulation.hand.simulator import HandSpecies


def test_gestures_are_measured_from_the_pictures_alone() -> None:
    estimator = PoseEstimator.load("hand")
    gestures = HandSpecies(estimator.skeleton).motion(3, 24)
    scene, sample = HandSegmenter.learn(gestures, estimator.skeleton.view, 24)
    size = estimator.find_size(sample, scene)
    found = estimator.estimate(sample, scene, size)
    assert found.found.all()
    assert abs(size * estimator.skeleton.length / gestures.spine_mm - 1.0) < 0.12
    off = np.linalg.norm(
        found.chosen.pose.joints(estimator.skeleton) - gestures.joints_camera, axis=-1
    ).mean(axis=1)
    assert np.median(off) < 15.0
    assert (found.chosen.pose.scale > 0).all()
