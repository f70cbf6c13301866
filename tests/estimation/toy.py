"""A toy world: the default mouse, bare, on a tilted floor before a small camera; every pose is
known exactly.

The product's own foreground cuts the height maps, so a toy set is what training sees, only smaller.
"""

import tomllib
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface, render_meshes
from liex_lab.body.skeleton import PRESETS, Skeleton
from liex_lab.estimation.cascade import Candidates, ImageSet, TrainingSet, Truth
from liex_lab.estimation.method import METHODS, Method
from liex_lab.estimation.model import ErrorCalibration, Model
from liex_lab.estimation.training import train_cascade, train_metric
from liex_lab.forests.grow import GrowthPlan
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from tests.scene.staged import bare_floor

CAMERA = Camera(300.0, 300.0, 79.5, 59.5, 160, 120)
FLOOR = Floor.from_plane(np.array([0.06, -0.04, 1.0]), 600.0, CAMERA)
SCENE = bare_floor(CAMERA, FLOOR)


@dataclass(frozen=True)
class Toy:
    """Depth frames (n, H, W) mm and the true poses (n) in the arena frame."""

    depths: NDArray[np.float32]
    pose: Pose
    skeleton: Skeleton

    @property
    def joints(self) -> np.ndarray:
        """(n, J, 3) mm, arena frame."""
        return self.pose.joints(self.skeleton)


def toy_mice(
    n: int, seed: int, noise_mm: float | np.ndarray = 1.0, size: tuple[float, float] = (0.9, 1.1)
) -> Toy:
    """Mice that look anywhere, bend a little and lift their noses a little; noise_mm of all
    readings, or (n,).
    """
    rng = np.random.default_rng(seed)
    skeleton = Skeleton.load("mouse")
    zero, scale = np.zeros(n), rng.uniform(*size, n)
    angles = np.zeros((n, skeleton.n_joints, 3))
    angles[:, 1:4, 2], angles[:, 1:4, 1] = rng.normal(0, 0.25, (n, 3)), rng.normal(0, 0.1, (n, 3))
    rotation = so3.exp(np.stack([zero, zero, rng.uniform(-np.pi, np.pi, n)], 1))
    rotation = rotation @ so3.exp(np.stack([zero, -np.abs(rng.normal(0, 0.15, n)), zero], 1))
    pose = Pose(SE3(rotation, np.zeros((n, 3))), angles, scale)
    middle = pose.joints(skeleton).mean(axis=1)
    place = np.stack(
        [rng.uniform(-70, 70, n), rng.uniform(-45, 45, n), 14.0 * scale + middle[:, 2]], 1
    )
    pose = Pose(SE3(rotation, place - middle), angles, scale)
    depths = rendered(skeleton, pose)
    noise = np.broadcast_to(noise_mm, n)[:, None, None] * rng.normal(0, 1, depths.shape)
    return Toy((depths + noise).astype(np.float32), pose, skeleton)


def rendered(
    skeleton: Skeleton,
    pose: Pose,
    girth: float = 1.0,
    camera: Camera = CAMERA,
    floor: Floor = FLOOR,
    shape: BodyShape | None = None,
) -> NDArray[np.float32]:
    """Depth (n, H, W) mm of a body, the default one, in poses (n), arena frame, on the floor."""
    n, surface = len(pose.scale), Surface.of(skeleton)
    T_camera_arena = floor.T_arena_camera.inverse()
    T = SE3(
        np.repeat(T_camera_arena.rotation[None], n, 0),
        np.repeat(T_camera_arena.translation[None], n, 0),
    )
    vertices = surface.vertices(pose, shape, girth=girth * pose.scale)
    lens = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (n, 1))
    body = render_meshes(
        vertices, surface.faces, T, lens, np.zeros((n, 2)), (camera.width, camera.height)
    )
    bare = floor.depth(camera.width, camera.height)
    return np.where((body > 0) & (body < bare), body, bare)


def with_box(depth: NDArray[np.float32], x_mm: float, y_mm: float) -> NDArray[np.float32]:
    """A frame (H, W) mm with a box of about a mouse's area at a place of the floor."""
    T_camera_arena = FLOOR.T_arena_camera.inverse()
    corners = [[x_mm - 18, y_mm + 15, 0], [x_mm + 18, y_mm - 15, 0]]
    (u0, v0), (u1, v1) = np.rint(CAMERA.project(T_camera_arena @ corners)).astype(int)
    out = depth.copy()
    out[v0:v1, u0:u1] = FLOOR.depth(CAMERA.width, CAMERA.height)[v0:v1, u0:u1] - 45.0
    return out


def training_set(toy: Toy, method: Method) -> TrainingSet:
    """The toy's height maps with the truth in their view frames."""
    crops = SCENE.extract(toy.depths, 1.0, camera_view=method.camera_view)
    crop_cameras = SCENE.crop_cameras(crops, method.camera_view)
    rotation = SCENE.view_rotation(method.camera_view)
    n = len(crop_cameras)
    above = np.stack([np.zeros(n), np.zeros(n), crops.distance], 1)
    T_view_camera = SE3(np.repeat(rotation[None], n, 0), above)
    pose = toy.pose.moved(T_view_camera @ SCENE.floor.T_arena_camera.inverse())
    frames = pose.frames(toy.skeleton)
    assert crops.found.all()
    return TrainingSet(
        ImageSet(crops.heights, crop_cameras, crops.moments),
        Truth(frames.rotation, frames.translation, pose.scale),
        pose.scale.copy(),
        np.ones(n, np.bool_),
    )


def tiny(variant: str) -> Method:
    """A variant with few and shallow trees; all else is as it is. 'seen' is the default as a hand
    has it: it starts from proposals, its metric knows what is left unexplained, and the chosen pose
    is taken into the picture.
    """
    if variant == "seen":
        proposals = GrowthPlan(4, 12, 4, 60, 0.3, 0.15, 0.3, 0.63)
        return replace(
            tiny("default"),
            proposals=proposals,
            proposal_reach_mm=40.0,
            base_rounds=3,
            explains=True,
            refine_steps=3,
            refined=2,
        )
    method = METHODS[variant]
    return replace(
        method,
        rounds=2,
        n_candidates=8,
        training_candidates=4,
        regressors=method.regressors._replace(n_trees=4, max_depth=12, min_leaf=5, n_tests=60),
        metric=method.metric._replace(n_trees=12, max_depth=8, min_leaf=8, n_tests=60),
        metric_shrinkage=0.4 if method.metric_shrinkage else 0.0,
        survivors=0,
        pruner=None,
        corrector=None,
    )


@dataclass(frozen=True)
class Trained:
    """A toy model, what it learned from, and the training candidates as the cascade left them."""

    model: Model
    data: TrainingSet
    candidates: Candidates


def train(toy: Toy, method: Method, seed: int = 0) -> Trained:
    """A model of the toy world, not calibrated but for the animal's area."""
    rng = np.random.default_rng(seed)
    data = training_set(toy, method)
    cascade, candidates = train_cascade(data, toy.skeleton, method, rng, lambda share, what: None)
    metric = train_metric(data, cascade, candidates, rng)
    table = tomllib.loads((PRESETS / "mouse.toml").read_text(encoding="utf-8"))
    area = float(np.median(data.images.moments[:, 1] / data.size**2))
    return Trained(
        Model(cascade, metric, None, table, ErrorCalibration(area_mm2=area)), data, candidates
    )


@cache
def trained(variant: str) -> Trained:
    """The toy model of a variant, trained once for all tests; do not change it."""
    return train(toy_mice(500, 1), tiny(variant))


@cache
def unseen() -> Toy:
    """Mice that no toy model has learned from."""
    return toy_mice(200, 2)
