"""Foreign bodies: virtual animals that do not come from the generator of the training images.

The bodies in training are tubes along the chain of joints. A foreign body is an implicit surface,
the smooth union of ellipsoids (Blinn 1982)

    sum_i exp(-d_i / b) = 1,    d_i: distance from ellipsoid i, b: width of the blend,

on which the vertices of all ellipsoids lie, skinned linearly to the segments of a spine by weights
of distance. It moves along sums of sinusoids of random periods. The sensor adds speckle that is
correlated in space, fur, lost and flying pixels at outlines, and rounds to steps. Proportions
follow from the number of the body; motion, scene and noise also from the seed. The truth has the
form of docs/reference/truth.md.
"""

from collections.abc import Mapping
from functools import cached_property
from itertools import product
from typing import Any, Final

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp, softmax

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import joined_faces
from liex_lab.body.shape import render_mesh
from liex_lab.errors import LiexError, refuse
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording
from liex_lab.simulation.recording import TrueAnimal
from liex_lab.simulation.scene import SPHERE_TUBE, SceneSpec, SimulatedScene, rounded
from liex_lab.simulation.species import TANK

# ellipsoids: place along the spine (0 rear, 1 front), left, up; radii forward, left, up; all in
# body lengths. Those with left > 0 exist on both sides
_MOUSE = (
    (0.13, 0.0, -0.02, 0.19, 0.16, 0.16),  # haunches
    (0.38, 0.0, -0.03, 0.26, 0.17, 0.17),
    (0.62, 0.0, -0.02, 0.18, 0.13, 0.14),  # chest
    (0.80, 0.0, 0.00, 0.13, 0.09, 0.095),  # skull
    (0.935, 0.0, -0.01, 0.09, 0.045, 0.05),
    (0.14, 0.13, -0.07, 0.12, 0.06, 0.09),  # thighs
    (0.18, 0.15, -0.17, 0.11, 0.03, 0.025),
    (0.66, 0.09, -0.14, 0.05, 0.03, 0.05),
    (0.76, 0.085, 0.09, 0.025, 0.05, 0.05),  # ears
    *((-0.04 - 0.1 * k, 0.0, -0.02, 0.075, 0.026 - 0.002 * k, 0.026 - 0.002 * k) for k in range(7)),
)
_FISH = (
    (0.89, 0.0, 0.00, 0.11, 0.055, 0.07),  # head
    (0.66, 0.0, -0.01, 0.26, 0.07, 0.105),
    (0.38, 0.0, 0.00, 0.25, 0.045, 0.075),
    (0.20, 0.0, 0.00, 0.12, 0.020, 0.04),
    (0.08, 0.0, 0.05, 0.09, 0.006, 0.05),  # thin fins: tail, back, belly, sides
    (0.08, 0.0, -0.05, 0.09, 0.006, 0.05),
    (0.42, 0.0, 0.10, 0.09, 0.006, 0.06),
    (0.36, 0.0, -0.09, 0.09, 0.006, 0.055),
    (0.74, 0.08, -0.04, 0.06, 0.035, 0.006),
)
_SEGMENT = 0.05  # of the spine, body lengths
SEALED_BODY: Final = 953_200  # bodies from here on are reserved for the sealed part


TRUTH_FORM: Final = "docs/reference/truth.md describes the form"

# lengths in mm; factor of the height of limbs, which lift the belly off the floor; rear end of the
# spine and width of the blend in body lengths; frames per second;
# speckle at the floor, mm; cameras and steps of depth, mm, of the bodies in turn
KINDS: Final[dict[str, dict[str, Any]]] = {
    "mouse": {
        "parts": _MOUSE,
        "n_bodies": 4,
        "length_mm": (54.0, 84.0),
        "stance": (1.0, 1.7),
        "rear": -0.75,
        "blend": 0.018,
        "setting": SceneSpec(camera_mm=(480.0, 780.0)),
        "rate_hz": 30,
        "speckle_mm": (0.6, 1.6),
        "steps_mm": (1.0, 2.0),
        "cameras": (
            Camera(365.0, 365.0, 256.0, 212.0, 512, 424, source="foreign, 70 degrees"),
            Camera(600.0, 600.0, 320.0, 240.0, 640, 480, source="foreign, 56 degrees"),
        ),
    },
    "fish": {
        "parts": _FISH,
        "n_bodies": 3,
        "length_mm": (26.0, 34.0),
        "stance": (1.0, 1.0),
        "rear": 0.0,
        "blend": 0.006,
        "setting": TANK,
        "rate_hz": 50,
        "speckle_mm": (0.1, 0.4),
        "steps_mm": (0.05, 0.1, 0.2),
        "cameras": (Camera(1900.0, 1900.0, 400.0, 400.0, 800, 800, source="foreign, near"),),
    },
}


class ForeignRecording(Recording):
    """A virtual recording of a foreign body, rendered frame by frame.

    Attributes:
        length_mm: length of the animal's spine, mm.
    """

    def __init__(
        self, animal: str = "mouse", body: int = 0, seed: int = 0, frames: int = 300
    ) -> None:
        """Draw a body by its number, and everything else by the seed.

        Args:
            animal: a key of `KINDS`.
            body: number of the body.
            seed: of motion, scene and noise.
            frames: length of the recording.
        """
        kind, self._floats = KINDS[animal], animal == "fish"
        self._seed = [int(self._floats), body, seed]
        own, rng = (np.random.default_rng(self._seed[:n]) for n in (2, 3))
        self.length_mm = float(own.uniform(*kind["length_mm"]))
        parts = _drawn(own, kind["parts"])
        self._fur, self._grain_px = own.uniform([0.1, 0.7], [0.5, 1.8])
        self._speckle_mm = own.uniform(*kind["speckle_mm"])
        limbs = (parts[:, 1] != 0) & (parts[:, 2] < 0)
        parts[np.ix_(limbs, [2, 5])] *= own.uniform(*kind["stance"])
        vertices, self._faces = _mesh(parts, kind["blend"])
        self._step_mm, camera = (kind[of][body % len(kind[of])] for of in ("steps_mm", "cameras"))
        self._scene = SimulatedScene.draw(rng, camera, self.length_mm, kind["setting"])
        ends = np.arange(round(kind["rear"] / _SEGMENT), round(1.0 / _SEGMENT)) * _SEGMENT
        self._rest, self._middle = self.length_mm * vertices, ends + _SEGMENT / 2.0
        away = (vertices[:, :1] - self._middle) / (1.2 * _SEGMENT)
        self._weights = softmax(-(away**2), axis=1)
        time_s = np.arange(frames) / kind["rate_hz"]
        self._turned, self._nodes = self._posed(rng, time_s)
        super().__init__(
            name=f"foreign-{animal}-{body}-{seed}",
            format="synthetic",
            camera=camera,
            times_ns=np.round(1e9 * time_s),
            read=self._sensed,
        )

    def _posed(self, rng: np.random.Generator, time_s: Array) -> tuple[Array, Array]:
        """Rotations (n, K, 3, 3) of the segments and their ends (n, K + 1, 3) mm, arena frame.

        A mouse stands on the floor; a fish floats, its waves growing towards the tail.
        """
        s, scene, length = self._middle, self._scene, self.length_mm
        pace, turn, curl, arch, lift, height = _wander(rng, time_s, 6)[..., None]
        speed, step_s = np.clip(0.9 + 0.9 * pace, 0.0, 3.0), np.gradient(time_s)[:, None]
        turning = rng.choice([-0.7, 0.7]) + 0.8 * turn
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(turning * step_s, axis=0)
        yaw = heading + np.clip(0.3 * turning + 0.35 * curl, -1.1, 1.1) * (s - 0.5)
        if self._floats:
            beat = 10.0 * np.cumsum((1.0 + speed) * step_s, axis=0)
            yaw += 0.5 * (1.0 - s) ** 2 * np.sin(beat + 7.0 * s)
            pitch = 0.12 * arch + 0.0 * s
        else:
            yaw += 0.9 * np.minimum(s, 0.0) * height
            pitch = (0.2 + 0.15 * arch) * (1.0 - 2.2 * s)  # an arched back; it rears
            pitch += np.clip(lift - 0.8, 0.0, 0.9) * np.clip((s + 0.2) / 0.6, 0.0, 1.0)
            pitch = np.where(s < 0, 0.55 * np.exp(np.minimum(s, 0.0) / 0.25), pitch)
        angles = np.stack([yaw, -pitch], axis=-1).reshape(-1, 2)
        turned = Rotation.from_euler("ZY", angles).as_matrix().reshape(*yaw.shape, 3, 3)
        nodes = np.cumsum(length * _SEGMENT * np.pad(turned[..., 0], ((0, 0), (1, 0), (0, 0))), 1)
        path = length * np.cumsum(speed * step_s * np.hstack([np.cos(heading), np.sin(heading)]), 0)
        path -= (path.max(axis=0) + path.min(axis=0)) / 2.0
        free = max(scene.freedom(scene.centre) - 0.7 * length, 0.3 * length)
        path *= min(1.0, free / (np.linalg.norm(path, axis=1).max() + 1e-9))
        nodes[..., :2] += (scene.centre + path - nodes.mean(axis=1)[:, :2])[:, None]
        carries = self._rest[:, 0] > -0.05 * length  # the tail does not carry the animal
        for i in range(len(nodes)):
            nodes[i, :, 2] -= self._skinned(turned[i], nodes[i])[carries, 2].min() - 0.5
        nodes[..., 2] += self._floats * length * np.clip(1.0 + 0.5 * height, 0.1, 2.2)
        return turned, nodes

    def _skinned(self, turned: Array, nodes: Array) -> Array:
        """Vertices (V, 3) mm, arena frame, of the segments' rotations and ends."""
        at_rest = self.length_mm * self._middle[:, None] * turned[..., 0]
        moved = (nodes[1:] + nodes[:-1]) / 2.0 - at_rest
        turns = (self._weights @ turned.reshape(-1, 9)).reshape(-1, 3, 3)
        return np.asarray(np.einsum("vij,vj->vi", turns, self._rest) + self._weights @ moved)

    def _sensed(self, index: int) -> Depth:
        """Depth (H, W) mm of a frame: the scene as the sensor reads it."""
        still, rng = self._scene.still, np.random.default_rng([*self._seed, index])
        body = render_mesh(
            self._skinned(self._turned[index], self._nodes[index]),
            self._faces,
            self.camera,
            T_camera_mesh=self._scene.T_arena_camera.inverse(),
        )
        animal = (body > 0) & ((still == 0) | (body < still))
        ideal = np.where(animal, body, still)
        near, far = minimum_filter(ideal, 3), maximum_filter(ideal, 3)
        edge = (far - near > 0.05 * self.length_mm) & (near > 0)
        chance, white = rng.random(ideal.shape), rng.standard_normal(ideal.shape)
        # speckle of unit standard deviation
        grain = 2.0 * np.sqrt(np.pi) * self._grain_px * gaussian_filter(white, self._grain_px)
        # rays end within the fur
        depth = (
            ideal + self._speckle_mm * grain + animal * self._fur * 0.03 * self.length_mm * chance
        )
        depth = np.where(edge & (chance < 0.35), near + (far - near) * chance / 0.35, depth)
        depth = np.where(edge & animal & (chance > 1.0 - self._fur), far, depth)
        depth = self._step_mm * np.round(depth / self._step_mm)
        depth[(ideal == 0) | (np.abs(grain) > np.where(edge, 1.6, 3.7))] = 0.0
        return depth.astype(np.float32)

    @cached_property
    def truth(self) -> dict[str, Array]:
        """The arrays of the truth file: joints, surface_mm, thickness_mm."""
        T = self._scene.T_arena_camera.inverse()
        joints = T @ self._nodes[:, -1 - round(1.0 / _SEGMENT) :: 2]
        joints = joints[:, ::-1] if self._floats else joints  # the fish's chain begins at the head
        bodies = (
            T @ self._skinned(*bones) for bones in zip(self._turned, self._nodes, strict=True)
        )
        each = zip(bodies, joints, strict=True)
        skins = np.stack([_through(body, self._faces, self.camera, here) for body, here in each])
        return {"joints": joints, "surface_mm": skins[..., 0], "thickness_mm": np.ptp(skins, -1)}

    def animal(self, shares: Array) -> TrueAnimal:
        """The truth at some places along the body; `shares` as in `truth_of`."""
        return truth_of(self.truth, self.name, self, shares)


def truth_of(
    arrays: Mapping[str, Any], name: str, recording: Recording, shares: Array
) -> TrueAnimal:
    """The truth in the arrays of a truth file, at some places along its curve.

    The joints of the result have z in the middle between the upper and the lower skin; they are
    NaN where it is unknown.

    Args:
        arrays: by name.
        name: of the file, in errors.
        recording: whose frames it is of.
        shares: (K,) places as shares of the length, from 0 to 1.

    Raises:
        LiexError: an array is missing or has another shape, there is no number in it, or the joints
            are not in view of the recording's camera.
        ValueError: an array is not of numbers, or an optional one has another shape.
    """
    needed, n, camera = ("joints", "surface_mm", "thickness_mm"), len(recording), recording.camera
    if lacking := [one for one in needed if one not in arrays]:
        raise LiexError(f"{name} lacks the array {', '.join(lacking)}; {TRUTH_FORM}")
    joints, surface, thickness = (np.asarray(arrays[one], float) for one in needed)
    refuse(
        LiexError,
        (
            joints.ndim != 3 or joints.shape[1] < 2 or joints.shape[2] != 3,
            f"{name}: joints should be frames x joints x (x, y, z) in mm, of at least two joints, "
            f"got {joints.shape}; {TRUTH_FORM}",
        ),
        (
            len(joints) != n,
            f"{name} has {len(joints)} frames and its recording {n}; state the truth of each frame",
        ),
        (
            {surface.shape, thickness.shape} != {joints.shape[:2]},
            f"{name}: surface_mm and thickness_mm should have a number for each frame and joint of "
            f"joints, {joints.shape[:2]}, got {surface.shape} and {thickness.shape}; {TRUTH_FORM}",
        ),
    )
    middle = surface + thickness / 2.0
    known = np.isfinite(joints).all(axis=-1) & np.isfinite(middle)
    if not known.any():
        raise LiexError(
            f"{name}: no joint has finite joints, surface_mm, thickness_mm; {TRUTH_FORM}"
        )
    steps = np.diff(joints, axis=1, prepend=joints[:, :1])
    arc = np.cumsum(np.linalg.norm(steps, axis=-1), axis=1)
    length = float(np.nanmedian(np.asarray(arrays.get("arc_mm", arc[:, -1]), float)))
    uv = camera.project(joints[known])
    inside = ((uv > -0.5) & (uv < np.array([camera.width, camera.height]) - 0.5)).all(axis=-1)
    refuse(
        LiexError,
        (
            inside.mean() < 0.5,
            f"{name}: most joints lie outside the view of the recording's camera; they should be "
            "in mm in its frame (x right, y down, z away)",
        ),
        (
            np.median(np.abs(middle - joints[..., 2])[known]) > length,
            f"{name}: surface_mm + thickness_mm / 2 lies more than a body length from the z of the "
            "joints; they should be depths from the camera and thicknesses, in mm",
        ),
    )
    values = np.stack([joints[..., 0], joints[..., 1], middle], axis=-1)
    points = np.full((n, len(shares), 3), np.nan)
    for i, k in product(np.flatnonzero((arc[:, -1] > 0) & known.any(axis=1)), range(3)):
        ok = np.isfinite(values[i, :, k])
        at, ends = arc[i, ok] / arc[i, -1], {"left": np.nan, "right": np.nan}
        points[i, :, k] = np.interp(shares, at, values[i, ok, k], **ends)
    visible = np.asarray(arrays.get("visible_fraction", 1.0), float)
    return TrueAnimal(length, points, np.broadcast_to(visible, n))


def _wander(rng: np.random.Generator, time_s: Array, n: int) -> Array:
    """Random smooth paths (n, len(time_s)) of unit standard deviation: six sinusoids each."""
    period, phase = rng.uniform(0.7, 6.0, (n, 6, 1)), rng.uniform(0.0, 2 * np.pi, (n, 6, 1))
    return np.asarray(np.sin(2 * np.pi * time_s / period + phase).sum(axis=1) / np.sqrt(3))


def _drawn(rng: np.random.Generator, parts: tuple[tuple[float, ...], ...]) -> Array:
    """The ellipsoids (P, 6) of one body: wide or narrow, flat or high, each part in proportion."""
    wide, high = rng.uniform([0.9, 0.8], [1.4, 1.3])
    drawn = np.array(parts) * [1.0, wide, high, 1.0, wide, high]
    drawn[:, 3:] *= rng.uniform(0.88, 1.14, (len(parts), 3))
    drawn[:, 0] += rng.normal(0.0, 0.012, len(parts))
    return np.concatenate([drawn, drawn[drawn[:, 1] > 0] * [1.0, -1.0, 1.0, 1.0, 1.0, 1.0]])


def _outside(parts: Array, points: Array, blend: float) -> Array:
    """Approximate distance (V,) of points (V, 3) from the smooth union, negative inside."""
    scaled = (points[:, None] - parts[:, :3]) / parts[:, 3:]
    radius, slope = (np.linalg.norm(one, axis=-1) for one in (scaled, scaled / parts[:, 3:]))
    distance = radius * (radius - 1.0) / (slope + 1e-9)
    return np.asarray(-blend * logsumexp(-distance / blend, axis=-1))


def _mesh(parts: Array, blend: float) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) and triangles (F, 3): ellipsoids whose vertices Newton's method moves onto
    the surface of the smooth union.
    """
    whole = rounded(parts[:, :3], parts[:, 3:], np.zeros(len(parts)), np.full(len(parts), 2.0))
    vertices, tiny = whole.reshape(-1, 3), 1e-5
    for _ in range(5):
        here = _outside(parts, vertices, blend)[:, None]
        slope = np.stack(
            [_outside(parts, vertices + tiny * axis, blend) for axis in np.eye(3)], axis=-1
        )
        slope = (slope - here) / tiny
        vertices = vertices - here * slope / np.maximum((slope**2).sum(axis=1), 0.25)[:, None]
    return vertices, joined_faces([SPHERE_TUBE] * len(parts))


def _through(vertices: Array, faces: NDArray[np.int32], camera: Camera, joints: Array) -> Array:
    """Depths at which the ray through each joint enters and leaves a mesh.

    Args:
        vertices: (V, 3) mm, camera frame.
        faces: (F, 3).
        camera: the camera.
        joints: (J, 3) mm, camera frame.

    Returns:
        (J, 2) mm; NaN if it misses.
    """
    uv, inverse = camera.project(vertices)[faces], 1.0 / vertices[faces, 2]
    (bu, bv), (cu, cv) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    u, v = np.moveaxis(camera.project(joints)[:, None] - uv[:, 0], -1, 0)
    area = bu * cv - bv * cu + 1e-12
    of_b, of_c = (u * cv - v * cu) / area, (bu * v - bv * u) / area
    shares = np.stack([1.0 - of_b - of_c, of_b, of_c])
    depth = 1.0 / np.einsum("kjf,fk->jf", shares, inverse)
    depth[(shares < 0).any(axis=0)] = np.nan
    return np.stack([np.fmin.reduce(depth, axis=1), np.fmax.reduce(depth, axis=1)], axis=-1)
