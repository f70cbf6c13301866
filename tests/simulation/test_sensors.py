"""Noise models of sensors: they err as the real ones do."""

import hashlib

import numpy as np
import pytest

from liex_lab.simulation import _sensor_kernels as k
from liex_lab.simulation.sensors import (
    BY_NAME,
    KINECT_V2_SENSOR,
    PRIMESENSE_SENSOR,
    RAYTRIX_R5_SENSOR,
    Sensor,
)
from liex_lab.simulation.simulator import open_synthetic
from liex_lab.simulation.species import MouseSpecies

SIDE = 240


def sensed(
    sensor: Sensor,
    depth: np.ndarray | float,
    what: np.ndarray | int = k.STILL,
    parameters: np.ndarray | None = None,
    /,
    **changes: float,
) -> np.ndarray:
    """Readings of an ideal scene by one unit of a sensor, mm, 0 if unread."""
    if parameters is None:
        parameters = sensor.draw(np.random.default_rng(0), 1, np.zeros(1))[0]
    for name, value in changes.items():
        parameters[getattr(k, name)] = value
    ideal = np.full((SIDE, SIDE), depth, np.float32)
    out = np.empty(ideal.shape, np.uint16)
    k.sense(
        ideal,
        np.full(ideal.shape, what, np.uint8),
        parameters,
        sensor.camera.fx,
        SIDE / 2,
        SIDE / 2,
        np.array([99], np.uint64),
        k.NORMAL,
        np.empty(ideal.shape, np.float32),
        out,
    )
    return out * parameters[k.UNIT]


def typical(sensor: Sensor, noise: float = 1.0) -> np.ndarray:
    """The mean parameters of 200 units."""
    p = sensor.draw(np.random.default_rng(0), 200, np.zeros(200), noise).mean(axis=0)
    p[k.SIDE] = 1.0
    return p


def block(low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
    """A block 800 mm away, taken for an animal, before a wall at 900 mm."""
    inside = np.zeros((SIDE, SIDE), bool)
    inside[low:high, low:high] = True
    return np.where(inside, 800.0, 900.0), np.where(inside, k.ANIMAL, k.STILL)


@pytest.mark.parametrize("sensor", [PRIMESENSE_SENSOR, KINECT_V2_SENSOR])
def test_noise_grows_with_distance_and_with_the_noise_factor(sensor: Sensor) -> None:
    near, far, noisy = (
        sensed(sensor, depth, k.STILL, typical(sensor, noise))
        for depth, noise in ((500.0, 1.0), (1500.0, 1.0), (1500.0, 2.0))
    )
    spreads = [np.std(out[out > 0]) for out in (near, far, noisy)]
    assert 0.2 < spreads[0] < 2.0
    assert spreads[1] > 1.5 * spreads[0]
    assert 1.6 < spreads[2] / spreads[1] < 2.4
    assert abs(near[near > 0].mean() - 500.0) < 1.0


def test_a_primesense_reads_only_depths_of_whole_eighths_of_disparity() -> None:
    out = sensed(PRIMESENSE_SENSOR, 3000.0, k.STILL, typical(PRIMESENSE_SENSOR))
    eighths = PRIMESENSE_SENSOR.camera.fx * k.BASELINE_MM / out[out > 0] * k.SUBPIXEL
    assert np.abs(eighths - np.round(eighths)).max() < 0.03  # what rounding to whole mm leaves
    assert len(np.unique(out)) < 40


def test_the_shadow_of_a_step_is_as_wide_as_the_baseline_makes_it() -> None:
    fb = PRIMESENSE_SENSOR.camera.fx * k.BASELINE_MM
    width = fb / 700.0 - fb / 900.0
    ideal = np.full((SIDE, SIDE), 900.0)
    ideal[:, 60:90] = 700.0
    quiet = {"NOISE": 0.0, "LUMPS": 0.0, "JITTER": 0.0}
    for side, band in ((1.0, slice(60 - int(width), 60)), (-1.0, slice(90, 90 + int(width)))):
        unread = sensed(PRIMESENSE_SENSOR, ideal, SIDE=side, **quiet)[80] == 0
        assert abs(unread.sum() - width) <= 1.5
        assert unread[band].mean() > 0.9
        assert not unread[60:90].any()


def test_a_kinect_mixes_depths_at_an_outline_and_a_primesense_does_not() -> None:
    depth, what = block(60, 100)
    outs = [sensed(one, depth, what, FLYING=0.5) for one in (PRIMESENSE_SENSOR, KINECT_V2_SENSOR)]
    structured, time_of_flight = (((out > 820) & (out < 880)).sum() for out in outs)
    assert time_of_flight > 20 > structured


# the light-field camera


def plenoptic(distance_mm: float, **changes: float) -> np.ndarray:
    """A flat animal at a distance."""
    usual = {"LUMPS": 0.0, "OUTLIERS": 99.0, "DARK": -99.0}
    return sensed(RAYTRIX_R5_SENSOR, distance_mm, k.ANIMAL, **usual | changes)


def test_range_noise_grows_with_the_square_of_the_distance_and_is_mostly_smooth() -> None:
    near, far, noisy = (
        plenoptic(distance, SMOOTH=1.0, NOISE=noise)
        for distance, noise in ((200.0, 1.0), (400.0, 1.0), (200.0, 2.0))
    )
    assert near.mean() == pytest.approx(200.0, abs=0.3)
    assert far.std() / near.std() == pytest.approx(4.0, rel=0.1)
    assert noisy.std() / near.std() == pytest.approx(2.0, rel=0.1)
    assert np.diff(near, axis=1).std() < 0.8 * near.std()


def test_skin_without_texture_is_unread_or_filled_and_some_is_matched_wrongly() -> None:
    bare, filled = (plenoptic(250.0, DARK=-0.5, FLYING=filled) for filled in (0.0, 1.0))
    assert 0.1 < (bare == 0).mean() < 0.5
    assert (filled == 0).mean() == 0.0
    assert filled.std() > bare[bare > 0].std()
    wrong = np.abs(plenoptic(250.0, OUTLIERS=2.4) - 250.0)
    assert 0.0005 < (wrong > 8.0).mean() < 0.05


# cameras that one can buy


@pytest.mark.parametrize("name", ["gemini-335", "d435", "d455", "d405"])
def test_stereo_errs_by_the_square_of_the_distance_over_focal_length_and_baseline(
    name: str,
) -> None:
    sensor = BY_NAME[name]
    spread = []
    for distance in (500.0, 1000.0):
        out = sensed(sensor, distance, k.STILL, typical(sensor), STEPS=1024.0)
        spread.append(np.std(out[out > 0]) * sensor.camera.fx * sensor.baseline_mm / distance**2)
    assert spread[0] == pytest.approx(spread[1], rel=0.15)  # px of disparity at every distance
    assert 0.04 < spread[0] < 0.12


def test_time_of_flight_cameras_of_today_err_by_a_millimetre_or_two() -> None:
    sensor = BY_NAME["femto-bolt"]
    near, far = (
        np.std(out[out > 0])
        for out in (sensed(sensor, mm, k.STILL, typical(sensor)) for mm in (700.0, 2500.0))
    )
    assert 0.4 < near < 1.5 < far < 6.0


def test_dark_fur_is_read_with_more_noise_than_the_floor() -> None:
    for name in ("femto-bolt", "d435"):
        quiet, noisy = (
            np.std(out[out > 0])
            for out in (
                sensed(BY_NAME[name], 800.0, k.ANIMAL, WEAK=weak, LUMPS=0.0, DARK=0.0)
                for weak in (0.0, 2.0)
            )
        )
        assert noisy / quiet == pytest.approx(3.0, rel=0.25)


def test_only_the_edges_that_a_motion_sweeps_are_lost() -> None:
    depth, what = block(60, 120)
    quiet = {"NOISE": 0.0, "LUMPS": 0.0, "EDGE_DROP": 0.0, "FLYING": 0.0, "BIAS": 0.0}
    still, moving = (
        sensed(BY_NAME["femto-bolt"], depth, what, MOTION_U=px, **quiet) for px in (0.0, 8.0)
    )
    assert set(np.unique(still)) == {800.0, 900.0}
    swept = moving != still
    assert swept[61:119, 56:65].mean() > 0.8  # within half of the motion of an edge
    assert swept[61:119, 115:124].mean() > 0.8
    assert not swept[61:119, 66:114].any()
    assert not swept[:59].any()
    assert 0.3 < (moving[swept] == 0).mean() < 0.7


def test_a_walking_mouse_moves_in_the_sensor_and_independent_postures_do_not() -> None:
    moved = []
    for moving in (True, False):
        film = MouseSpecies().film(3, 8, sensor=BY_NAME["femto-bolt"], moving=moving)
        moved.append(np.hypot(*film.stage.parameters[:, [k.MOTION_U, k.MOTION_V]].T).max())
    assert 0.05 < moved[0] < 10.0
    assert moved[1] == 0.0


def test_sensors_that_models_were_trained_with_record_the_same_bytes_as_ever() -> None:
    film = open_synthetic("synthetic:walk?seed=3&frames=1&sensor=primesense-qvga")
    digest = hashlib.sha256(film.frame(0).depth.tobytes()).hexdigest()
    assert digest.startswith("19fadd018e7594fb")
