"""Skeletons: the paper's counts, kinematics against the product of exponentials, and errors that
name the mistake.
"""

import tomllib

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.pose import aim
from liex_lab.body.skeleton import PRESETS, CameraView
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3, so3
from tests.oracles import motion


def test_presets_have_the_papers_joints_and_degrees_of_freedom_and_bone_ratios():
    skeletons = [Skeleton.load(animal) for animal in ("fish", "mouse", "hand")]
    assert [(s.n_joints, s.dof) for s in skeletons] == [(21, 25), (5, 12), (23, 26)]
    mouse = skeletons[1]
    bones = np.linalg.norm(mouse.offsets[1:], axis=1)
    np.testing.assert_allclose(bones / bones.sum(), [0.2440, 0.2090, 0.2256, 0.3214], atol=1e-4)
    assert mouse.length == pytest.approx(52.834, abs=1e-3)


def test_published_mouse_poses_are_poses_of_our_skeleton(reference_data):
    skeleton = Skeleton.load("mouse")
    rows = np.loadtxt(reference_data / "liex_tracks" / "mouse_S1_frames_1_40.txt").reshape(-1, 5, 3)
    joints = rows * np.array(
        [1.0, 1.0, 1.0]
    )  # x right, y up, z towards the camera: already right-handed, z up
    pose = Pose.from_joints(skeleton, joints, np.array([0.0, 0.0, 1.0]))
    assert np.abs(pose.joints(skeleton) - joints).max() < 0.02
    np.testing.assert_allclose(pose.scale, np.round(pose.scale, 2), atol=2e-4)


def random_pose(skeleton: Skeleton, rng: np.random.Generator, n: int = 20) -> Pose:
    angles = rng.normal(0, 0.4, (n, skeleton.n_joints, 3)) * skeleton.axes
    angles[:, 0] = 0
    return Pose(SE3.exp(rng.normal(0, 1, (n, 6))), angles, rng.uniform(0.8, 1.3, n))


@pytest.mark.parametrize("animal", ["fish", "mouse", "hand"])
def test_kinematics_is_the_product_of_exponentials(animal):
    skeleton = Skeleton.load(animal)
    pose = random_pose(skeleton, np.random.default_rng(0), 1)
    frames = pose.frames(skeleton)
    for joint in range(skeleton.n_joints):
        chain: list[np.ndarray] = []
        j = joint
        while j > 0:
            move = np.concatenate([np.zeros(3), pose.scale[0] * skeleton.offsets[j]])
            rest = np.concatenate([so3.log(skeleton.rest[j]), np.zeros(3)])
            turn = np.concatenate([pose.angles[0, j], np.zeros(3)])
            chain = [move, rest, turn, *chain]
            j = int(skeleton.parents[j])
        root = pose.root.log()[0]
        by_hand = motion.chain([root, *chain])[-1]
        np.testing.assert_allclose(frames[0, joint].matrix, by_hand, atol=1e-9)


@pytest.mark.parametrize("animal", ["fish", "mouse"])
def test_a_chain_is_recovered_from_its_joints(animal):
    skeleton = Skeleton.load(animal)
    pose = random_pose(skeleton, np.random.default_rng(1))
    joints = pose.joints(skeleton)
    again = Pose.from_joints(skeleton, joints, pose.root.rotation[:, :, 2])
    np.testing.assert_allclose(again.joints(skeleton), joints, atol=1e-9)
    np.testing.assert_allclose(again.scale, pose.scale)


def test_aiming_turns_one_direction_onto_the_other_even_when_they_are_opposite():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 50, 3))
    b[0], b[1] = -a[0], 3 * a[1]
    turned = np.einsum(
        "nij,nj->ni", so3.exp(aim(a, b)), a / np.linalg.norm(a, axis=1, keepdims=True)
    )
    np.testing.assert_allclose(turned, b / np.linalg.norm(b, axis=1, keepdims=True), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t["joints"][2].update(parent="nose"), "listed before"),
        (lambda t: t["joints"][0].update(parent="nose"), "has no parent, got 'nose'"),
        (lambda t: t["joints"][1].update(axes=["jaw"]), "axes is a list out of"),
        (lambda t: t["joints"][1].update(lenght=3), "unknown key 'lenght'"),
        (lambda t: t["joints"][1].update(offset_mm=[1, 2]), "three numbers"),
        (lambda t: t.pop("joints"), "at least one"),
        (lambda t: t.update(joints=t["joints"][:1]), "a second joint at some distance"),
        (lambda t: t.update(view={"frame": "above"}), "one of floor, camera, got 'above'"),
        (lambda t: t.update(view={"foreground": 3}), "one of background, nearest, got 3"),
        (lambda t: t.update(view={"behind": 3}), "unknown key 'behind'"),
        (lambda t: t.update(view={"behind_mm": -1}), "behind_mm is a positive number"),
        (lambda t: t.update(view={"smooth_mm": True}), "smooth_mm is a positive number"),
        (lambda t: t.update(view={"area": [0.3]}), "two rising positive numbers"),
        (lambda t: t.update(view={"area": [0.3, 0.1]}), "two rising positive numbers"),
    ],
)
def test_a_mistake_in_a_skeleton_is_named(change, says):
    table = tomllib.loads((PRESETS / "mouse.toml").read_text(encoding="utf-8"))
    change(table)
    with pytest.raises(LiexError, match=says):
        Skeleton.from_table(table, "mine.toml")


def test_an_unknown_animal_names_the_nearest():
    with pytest.raises(LiexError, match="did you mean 'mouse'"):
        Skeleton.load("mose")


def test_a_view_follows_from_the_animals_size_unless_the_toml_states_it():
    mouse, fish = Skeleton.load("mouse"), Skeleton.load("fish")
    assert mouse.view == CameraView("floor", 120.0, 2.0, (0.12, 1.3), 7.0)
    assert (mouse.relative_size, fish.view.frame, fish.view.behind_mm) == (1.0, "camera", 30.0)
    assert fish.relative_size == pytest.approx(30.0 / 52.834, abs=1e-6)
    table = {**mouse.table, "joints": [dict(joint) for joint in mouse.table["joints"]]}
    for joint in table["joints"][1:]:
        joint["offset_mm"] = [3.0 * x for x in joint["offset_mm"]]
    large = Skeleton.from_table(table, "rat.toml").view
    assert [large.behind_mm, large.smooth_mm, large.min_height_mm] == pytest.approx(
        [360.0, 6.0, 7.0]
    )
