"""Two fish in one tank: both are measured, and keep their names while they cross."""

import hashlib
from dataclasses import replace

import numpy as np
from liex_lab.pipelines.evaluation.scenes import run_product

from liex_lab.evaluation.scores import error_of
from liex_lab.evaluation.several import track_counts, track_figures
from liex_lab.plan import Plan
from liex_lab.simulation.scenes.groups import KINDS, film_group
from liex_lab.simulation.sensors import RAYTRIX_R5_SENSOR

SMALL = replace(RAYTRIX_R5_SENSOR, camera=RAYTRIX_R5_SENSOR.camera.every(2), stride=1)


def test_two_fish_that_cross_are_both_measured_and_keep_their_names() -> None:
    recording, _ = film_group(
        4,
        120,
        animal="fish",
        apart=0.15,
        encounters=("cross",),
        sensor=SMALL,
        family="train",
        spine_mm=30.0,
    )
    recording.files.known_digest = hashlib.sha256(b"tank").hexdigest()
    found, said, _ = run_product(recording, Plan.load("fish").with_settings(["animal.count=2"]))
    assert len(found) == 2, said
    camera = recording.T_arena_camera.inverse()
    true = [camera @ one.joints for one in recording.stage.actors]
    gaps = [[error_of(one.joints_camera, joints) for one in found] for joints in true]
    off_mm = np.moveaxis(np.array(gaps, float), -1, 0)
    seconds = recording.times_ns.astype(float) * 1e-9
    counts = track_counts(off_mm / KINDS["fish"].unit, seconds)
    figures = track_figures(counts)
    assert counts["swaps"] == 0
    assert (figures["idf1"] or 0.0) > 0.8, said  # one is over the other meanwhile
    assert np.nanmedian(off_mm, axis=0).min(axis=1).max() < 1.5
