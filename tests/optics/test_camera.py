"""The camera: project undoes unproject, nothing is seen behind the lens, and a bent lens bends as
OpenCV says.
"""

import json
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.errors import LiexError
from liex_lab.optics.camera import KINECT_V2, PRIMESENSE, Camera, Distortion

pixels = st.floats(-50, 700)
cameras = st.sampled_from([KINECT_V2, PRIMESENSE, Camera(2363.0, 2360.0, 511.5, 500.0, 1024, 1024)])


@given(camera=cameras, u=pixels, v=pixels, depth=st.floats(100, 5000))
def test_project_undoes_unproject(camera: Camera, u: float, v: float, depth: float) -> None:
    point = camera.unproject([u, v], depth)
    assert point[2] == depth
    np.testing.assert_allclose(camera.project(point), [u, v], atol=1e-9)


def test_the_axes_point_as_agreed_and_points_behind_the_lens_are_nan() -> None:
    """x right, y down, z away; the optical axis meets the image in (cx, cy)."""
    ahead = [[0.0, 0.0, 700.0], [1.0, 0.0, 700.0], [0.0, 1.0, 700.0]]
    on_axis, right, down = PRIMESENSE.project(ahead)
    assert on_axis.tolist() == [PRIMESENSE.cx, PRIMESENSE.cy]
    assert right[0] > on_axis[0]
    assert down[1] > on_axis[1]
    behind = [[10.0, 20.0, z] for z in (0.0, -1.0, -600.0, math.nan)]
    assert np.isnan(PRIMESENSE.project(behind)).all()


def test_batches_keep_their_shape() -> None:
    rng = np.random.default_rng(0)
    uv, depth = rng.uniform(0, 400, (3, 5, 2)), rng.uniform(300, 900, (3, 5))
    points = KINECT_V2.unproject(uv, depth)
    np.testing.assert_allclose(KINECT_V2.project(points), uv, atol=1e-9)
    for shaped in (points, KINECT_V2.unproject(uv, 600.0), KINECT_V2.unproject([1.0, 2.0], depth)):
        assert shaped.shape == (3, 5, 3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx": 0.0},
        {"fy": -365.0},
        {"fx": math.nan},
        {"fx": math.inf},
        {"cx": math.nan},
        {"width": 0},
        {"height": -1},
    ],
)
def test_a_camera_that_cannot_be_is_refused_in_a_sentence(wrong: dict[str, Any]) -> None:
    with pytest.raises(LiexError, match=", got ") as caught:
        replace(KINECT_V2, **wrong)
    assert "\n" not in str(caught.value)


LENSES = [
    Distortion.of("plumb_bob", [-0.28, 0.08, 0.001, -0.002, -0.01]),
    Distortion.of("plumb_bob", [0.12, 0.03]),
    Distortion.of("rational_polynomial", [0.5, -2.6, 0.0007, -0.0003, 1.5, 0.38, -2.4, 1.4]),
    Distortion.of("equidistant", [-0.02, 0.01, -0.004, 0.0005]),
]


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_a_bent_lens_agrees_with_opencv_and_unproject_undoes_project(lens: Distortion) -> None:
    camera = replace(KINECT_V2, distortion=lens)
    v, u = np.mgrid[0 : camera.height : 13.0, 0 : camera.width : 13.0]
    points = replace(camera, distortion=None).unproject(np.stack([u, v], axis=-1), 600.0)
    seen = camera.project(points)
    flat, k = points.reshape(-1, 1, 3), np.array(lens.coefficients)
    still = np.zeros((3, 1))
    bend = cv2.fisheye.projectPoints if lens.model == "kannala_brandt" else cv2.projectPoints
    expected = bend(flat, still, still, camera.matrix, k)[0].reshape(seen.shape)
    np.testing.assert_allclose(seen, expected, atol=1e-8)
    np.testing.assert_allclose(camera.unproject(seen, 600.0), points, atol=1e-6)
    assert np.abs(seen - np.stack([u, v], axis=-1)).max() > 1.0, "it does bend"


def test_where_a_model_folds_back_nothing_is_seen() -> None:
    lens = Distortion.of("plumb_bob", [-0.4])
    assert lens is not None
    assert lens.limit == pytest.approx(np.sqrt(1 / 1.2), abs=0.01)  # where r - 0.4 r^3 turns
    assert np.isnan(lens.distort([1.0, 0.0])).all()
    assert np.isnan(lens.undistort([0.7, 0.0])).all(), "the model never reaches as far as this"
    assert np.isfinite(lens.undistort(lens.distort([[0.85, 0.1], [0.0, 0.0]]))).all()


@pytest.mark.parametrize(
    ("model", "k", "says"),
    [
        ("mei", [0.1], "'mei' is not supported"),
        ("plumb_bob", [0.1] * 12, "has up to 8 coefficients here, got 12"),
        ("equidistant", [0.1] * 5, "has up to 4"),
        ("plumb_bob", [math.nan], "finite"),
    ],
)
def test_a_distortion_that_cannot_be_used_is_refused_in_a_sentence(
    model: str, k: list[float], says: str
) -> None:
    with pytest.raises(LiexError, match=says):
        Distortion.of(model, k)


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_a_camera_of_any_lens_survives_its_own_table(lens: Distortion | None) -> None:
    camera = replace(PRIMESENSE, distortion=lens)
    assert (
        Camera.from_dict(json.loads(json.dumps(camera.to_dict())) | {"floor_distance_mm": 700.0})
        == camera
    )


@given(
    camera=cameras,
    stride=st.integers(1, 4),
    x=st.floats(-90, 90),
    y=st.floats(-90, 90),
    z=st.floats(150, 900),
)
def test_a_camera_of_every_other_pixel_sees_the_same_in_fewer_pixels(
    camera: Camera, stride: int, x: float, y: float, z: float
) -> None:
    coarse = camera.every(stride)
    np.testing.assert_allclose(
        stride * coarse.project([x, y, z]), camera.project([x, y, z]), atol=1e-9
    )
    assert coarse.width == len(range(0, camera.width, stride))
    assert coarse.height == len(range(0, camera.height, stride))
