"""A clock that runs too fast is told by how far the animal goes, whatever else moves."""

import numpy as np
import pytest

from liex_lab.body.skeleton import Skeleton
from liex_lab.tracking.track import Track
from liex_lab.tracking.trust import why_too_fast

LENGTH_MM = 45.0


def circling(speed_mm_s: float, hz: float, n: int = 300, noise_mm: float = 1.0) -> Track:
    """An animal on a circle of 200 mm."""
    times_s = np.arange(n) / hz
    track = Track.empty(Skeleton.load("mouse"), np.round(times_s * 1e9).astype(np.int64))
    turned = speed_mm_s * times_s / 200.0
    centre = 200.0 * np.stack([np.cos(turned), np.sin(turned), 0.1 + 0.0 * turned], axis=1)
    track.centroid_mm[:] = centre + np.random.default_rng(0).normal(0.0, noise_mm, (n, 3))
    return track


@pytest.mark.parametrize("hz", [10.0, 30.0, 200.0, 1000.0])
@pytest.mark.parametrize("speed_mm_s", [0.0, 100.0, 400.0])
def test_an_animal_that_goes_as_animals_do_is_believed(speed_mm_s: float, hz: float) -> None:
    assert why_too_fast(circling(speed_mm_s, hz, n=round(3 * hz) + 40), LENGTH_MM) == ""


def test_a_walk_by_a_clock_that_runs_17_times_too_fast_is_not() -> None:
    said = why_too_fast(circling(17 * 100.0, 17 * 30.0), LENGTH_MM)
    assert "37 of its lengths a second" in said or "38 of its lengths a second" in said
    assert "check the frame rate" in said


def test_a_burst_is_no_pace_and_of_a_few_frames_nobody_knows() -> None:
    track = circling(100.0, 100.0)
    track.centroid_mm[150:165] += np.linspace(0.0, 300.0, 15)[:, None]
    track.centroid_mm[165:] += 300.0
    assert why_too_fast(track, LENGTH_MM) == ""
    assert why_too_fast(circling(2000.0, 500.0, n=40), LENGTH_MM) == ""
    track.centroid_mm[:] = np.nan
    assert why_too_fast(track, LENGTH_MM) == ""
