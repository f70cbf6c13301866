"""The body held against the picture: the true pose explains it, a wrong one does not, and a fat
mouse stays fat.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import HeightMaps
from liex_lab.tracking.residual import BodyResidual, median_of
from tests.estimation.toy import SCENE, Toy, rendered, toy_mice
from tests.scene.staged import bare_floor

LARGE = Camera(
    1150.0, 1150.0, 319.5, 239.5, 640, 480
)  # so near that every second pixel fills a height map
LARGE_FLOOR = Floor.from_plane(np.array([-0.05, 0.03, 1.0]), 600.0, LARGE)


@pytest.fixture(scope="module")
def clean() -> Toy:
    return toy_mice(40, 7, noise_mm=0.0)


@pytest.fixture(scope="module")
def surface(clean: Toy) -> Surface:
    return Surface.of(clean.skeleton)


@pytest.fixture(scope="module")
def crops(clean: Toy) -> HeightMaps:
    return SCENE.extract(clean.depths, 1.0)


def moved(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return pose.moved(SE3(np.eye(3), np.array([x, y, z])))


def test_the_true_pose_explains_a_clean_picture_and_wrong_ones_do_not(clean, surface, crops):
    body = BodyResidual(surface)
    true = body.of(clean.pose, crops, SCENE)
    assert true.shape == (40,)
    assert np.median(true) < 0.5
    assert true.max() < 1.0
    assert (body.of(moved(clean.pose, x=8.0), crops, SCENE) > true).all()
    for lifted in (4.0, -4.0, 9.0):
        off = body.of(moved(clean.pose, z=lifted), crops, SCENE)
        assert np.median(off) == pytest.approx(abs(lifted), abs=0.8)
    assert np.isnan(body.of(moved(clean.pose, x=150.0), crops, SCENE)).all()
    none = np.zeros(40, np.bool_)
    assert body.of(clean.pose[none], crops[none], SCENE).shape == (0,)


def test_a_crop_of_every_second_pixel_is_explained_as_well(clean, surface):
    few = clean.pose[slice(0, 6)]
    scene = bare_floor(LARGE, LARGE_FLOOR)
    depths = rendered(clean.skeleton, few, camera=LARGE, floor=LARGE_FLOOR).astype(np.float32)
    crops = scene.extract(depths, 1.0)
    assert (crops.step > 1).all()
    assert BodyResidual(surface).of(few, crops, scene).max() < 1.0


@pytest.mark.parametrize("girth", [0.8, 1.0, 1.25])
def test_the_girth_of_an_animal_is_found_again(clean, surface, girth):
    depths = rendered(clean.skeleton, clean.pose, girth).astype(np.float32)
    body = BodyResidual.fit(surface, clean.pose, SCENE.extract(depths, 1.0), SCENE)
    assert body.girth == pytest.approx(girth, abs=0.051)


@pytest.mark.parametrize("stretch", [0.85, 1.15])
def test_a_tube_that_stretches_is_drawn_with_the_volume_that_it_had(clean, surface, stretch):
    """As the virtual mouse: girth is size / sqrt(stretch), and the true pose explains it again."""
    pose = replace(clean.pose, scale=np.full(40, stretch))
    girth = stretch**-1.5  # over the bones' scale, which `rendered` multiplies it by
    crops = SCENE.extract(rendered(clean.skeleton, pose, girth).astype(np.float32), 1.0)
    keeps = BodyResidual(surface, size=1.0).of(pose, crops, SCENE)
    with_bones = BodyResidual(surface).of(pose, crops, SCENE)
    assert np.median(keeps) < 0.5
    assert np.median(with_bones) > 3.0 * np.median(keeps)


def test_a_hand_is_as_thick_as_its_bones_are_long(clean, crops):
    home = Pose.home(Skeleton.load("hand"), 3)
    pose = replace(home, root=SE3(home.root.rotation, clean.pose.root.translation[:3]))
    surface = Surface.of(Skeleton.load("hand"))
    one, other = (
        BodyResidual(surface, size=size).agreement(pose, crops[:3], SCENE) for size in (None, 2.0)
    )
    assert np.isfinite(one.residual_mm).any()
    np.testing.assert_array_equal(one.residual_mm, other.residual_mm)


def test_frames_that_no_body_covers_leave_the_girth_as_it_is(clean, surface, crops):
    crops = crops[:3]
    far = moved(clean.pose[slice(0, 3)], x=5000.0)
    assert np.isnan(BodyResidual(surface).of(far, crops, SCENE)).all()
    assert BodyResidual.fit(surface, far, crops, SCENE).girth == 1.0
    # one frame that shows the animal is enough, whatever the others do
    mixed = far.moved(SE3.identity())
    mixed.root.translation[0] = clean.pose.root.translation[0]
    alone = BodyResidual.fit(surface, clean.pose[slice(0, 1)], crops[slice(0, 1)], SCENE)
    assert BodyResidual.fit(surface, mixed, crops, SCENE).girth == alone.girth


def test_a_head_that_lies_too_low_is_told_though_the_trunk_fits(clean, surface, crops):
    """The median over the whole body does not see it, that over its parts does."""
    body = BodyResidual(surface)
    bowed = replace(clean.pose, angles=clean.pose.angles.copy())
    bowed.angles[:, 3, 1] += 0.7  # the neck, about its own y axis
    right = body.agreement(clean.pose, crops, SCENE)
    wrong = body.agreement(bowed, crops, SCENE)
    assert right.part_mm.max() < 2.0
    assert (right.part_mm >= right.residual_mm).all()
    assert np.median(wrong.part_mm) > 3.0
    assert np.median(wrong.residual_mm) < 0.4 * np.median(wrong.part_mm)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 10, 1000, 1001])
def test_the_median_by_selection_is_that_of_sorted_numbers(n):
    rng = np.random.default_rng(n)
    for values in (rng.normal(0.0, 1.0, n), rng.integers(0, 4, n).astype(float), np.zeros(n)):
        assert median_of(values.copy()) == np.median(values)
