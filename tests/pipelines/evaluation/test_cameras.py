"""`liex evaluate cameras`: the same mouse before several cameras."""

import pytest
from liex_lab.pipelines.evaluation.cameras import evaluate_cameras, floor_noise_mm

from liex_lab.errors import LiexError
from liex_lab.optics.camera import DEPTH_MODES
from liex_lab.simulation.sensors import BY_NAME, ON_SALE
from liex_lab.simulation.species import MouseSpecies


def test_what_cannot_be_measured_is_refused() -> None:
    with pytest.raises(LiexError, match="femto-bolt"):
        evaluate_cameras(["kodak"])
    with pytest.raises(LiexError, match="200 to 3000 mm"):
        evaluate_cameras(["d435"], [50.0])


def test_the_floor_before_a_stereo_camera_is_noisier_than_before_one_with_a_long_baseline() -> None:
    noise = {
        name: floor_noise_mm(MouseSpecies().film(5, 1, sensor=BY_NAME[name]))
        for name in ("d455", "d435", "d405")
    }
    assert 0.2 < noise["d455"] < noise["d435"] < noise["d405"] < 20.0


def test_modes_of_one_sensor_see_the_same_angles_through_the_same_lens() -> None:
    modes = {(one.name, one.mode): one for one in DEPTH_MODES}
    for name in ("femto-bolt", "femto-mega"):
        whole, binned = (modes[name, f"NFOV {how}"].camera for how in ("unbinned", "binned"))
        assert whole.distortion == binned.distortion
        for pixel in ((0.0, 0.0), (200.0, 31.0)):  # a binned pixel is four of the whole image
            a = whole.unproject([2.0 * pixel[0] + 0.5, 2.0 * pixel[1] + 0.5], 800.0)
            assert binned.unproject(pixel, 800.0) == pytest.approx(a, abs=1.0)
    assert {sensor.name for sensor in ON_SALE} <= {one.name for one in DEPTH_MODES}
