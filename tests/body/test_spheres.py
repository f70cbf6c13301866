"""A body as balls: they lie along its bones, are as thick as it is, and move with it."""

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import Spheres, Surface
from liex_lab.estimation._residual_kernels import place_balls
from liex_lab.estimation.cascade import body_of


def placed(skeleton: Skeleton, pose: Pose) -> np.ndarray:
    balls, frames = Spheres.of(skeleton), pose.frames(skeleton)
    out = np.empty((len(balls.radius), 3))
    place_balls(
        frames.rotation[0], frames.translation[0], float(pose.scale[0]), body_of(balls), out
    )
    return out


@pytest.mark.parametrize(
    "animal", ["mouse", "hand"]
)  # not the fish: it is flat, and balls are as thick as it is wide
def test_balls_lie_within_the_body_and_reach_its_skin(animal: str) -> None:
    skeleton = Skeleton.load(animal)
    balls, surface = Spheres.of(skeleton), Surface.of(skeleton)
    middles = placed(skeleton, Pose.home(skeleton, 1))[: balls.n_own]
    skin = surface.vertices(Pose.home(skeleton))
    to_ball = np.linalg.norm(skin[:, None] - middles, axis=-1) - balls.radius[: balls.n_own]
    gap = to_ball.min(axis=1)  # of every point of the skin to the nearest ball
    assert np.abs(np.median(gap)) < 0.5 * np.median(balls.radius)
    assert (
        to_ball.min(axis=0) < 1.0 * balls.radius[: balls.n_own]
    ).all()  # no ball is far from the skin


def test_every_bone_of_a_hand_has_a_ball_at_its_end() -> None:
    hand = Skeleton.load("hand")
    balls = Spheres.of(hand)
    middles = placed(hand, Pose.home(hand, 1))
    joints = Pose.home(hand, 1).joints(hand)[0]
    off = np.linalg.norm(joints[1:, None] - middles[None, : balls.n_own], axis=-1).min(axis=1)
    assert off.max() < 1e-9


def test_an_arm_may_go_on_behind_a_hand_and_is_none_of_it() -> None:
    hand = Skeleton.load("hand")
    balls = Spheres.of(hand)
    beyond = placed(hand, Pose.home(hand, 1))[balls.n_own :]
    assert len(beyond) > 0
    assert (beyond[:, 0] < hand.offsets[1, 0]).all()  # further back than the wrist
    assert Spheres.of(Skeleton.load("mouse")).n_own == len(
        Spheres.of(Skeleton.load("mouse")).radius
    )
