"""Particle filter with Brownian motion on SE(3): Algorithm 3 of Lie-X (section 4.2) as published.

1. Select: draw K particles from the cumulative weights.
2. Propagate: the base joint by a left-invariant Brownian step, g exp(sqrt(δ) ξ) with ξ ~ N(0, C)
   (Eq. 6 and 7); every other joint by the cascade's regressors from its parent (Eq. 10).
   Regressors and metric are used as in Algorithm 1, see `Cascade.predict`. The paper does not state
   whether the base's own regressors run after its step; `base_rounds` of `ParticleFilter` selects
   this.
3. Measure: m is the learned metric's score; w = exp(-m^2 / 2 σ^2) (Eq. 12), normalised to sum 1
   (Eq. 13).
4. Estimate: the weighted average of tangent vectors (Eq. 14), taken at the average itself: the
   intrinsic mean on the group.

Choices that the paper leaves open are stated in `ProcessNoise` and in `ParticleFilter`. The filter
is kept for the evaluation tables; the default tracker is `curve` (`offline`).
"""

from dataclasses import dataclass, replace

import numpy as np

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import Array, Candidates, ImageSet
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.geometry import SE3, brownian_ends, brownian_steps, so3
from liex_lab.recordings.frame import DepthFrame
from liex_lab.scene.height_maps import Segmenter, view_of


@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of the base joint and scale of the metric's scores, left open by the paper.

    Lengths are those of an animal of the reference length.

    Attributes:
        n_particles: number of particles K.
        turn_rad: standard deviation of the rotation of a Brownian step about each axis, rad, Eq. 6.
        shift_mm: standard deviation of its translation along each axis, mm.
        delta_s: time δ of a Brownian step, s.
        sigma_mm: σ of Eq. 12, mm.
    """

    n_particles: int = 200
    turn_rad: float = 0.15
    shift_mm: float = 4.0
    delta_s: float = 1.0 / 30.0
    sigma_mm: float = 2.0

    @staticmethod
    def of(name: str, variant: str = "default", base_rounds: int = 0) -> "ProcessNoise":
        """The parameters of an animal.

        Between two frames a fish moves and turns three times as far as a mouse, relative to its
        length. Those of the paper's variant were found by `liex train tracking --particles` on
        development sequences, see `SEARCHED`.

        Args:
            name: name of the skeleton; 'fish' has its own, all others the default.
            variant: variant of the regressors and the metric, 'default' or 'paper'.
            base_rounds: rounds of the base joint, see `ParticleFilter`.

        Returns:
            The parameters; the animal's own if none were searched for the variant.
        """
        own = ProcessNoise(turn_rad=0.45, shift_mm=12.0) if name == "fish" else ProcessNoise()
        return SEARCHED.get((name, variant, base_rounds), own)


# by animal, variant and rounds of the base joint: the best of a pattern search on the first 60
# frames of 16 sequences, `liex train tracking --particles --animal mouse --frames 60`
SEARCHED: dict[tuple[str, str, int], ProcessNoise] = {
    ("mouse", "paper", 0): ProcessNoise(turn_rad=0.075, shift_mm=2.0, sigma_mm=1.0),
    ("mouse", "paper", 1): ProcessNoise(turn_rad=0.15, shift_mm=2.0, sigma_mm=1.0),
}


class ParticleFilter:
    """Tracks one animal frame by frame; its first detection initialises all particles.

    Selection, propagation of the base by Eq. 7 and of the other joints by Eq. 10, measurement by
    the learned metric with Eq. 12 and 13, and Eq. 14, where the average of tangent vectors is taken
    at the average itself, that is on the group. Each particle keeps the bones' scale of the first
    frame unless a base round corrects it. In a frame without a foreground the particles continue to
    diffuse.

    Args:
        estimator: the pose estimator whose regressors and metric are used.
        scene: the segmenter of the recording's camera.
        size: the animal's spine over the skeleton's home length.
        rng: random number generator.
        noise: process noise; None uses the animal's own.
        base_rounds: number of the base joint's last regression rounds that run on every particle
            after its Brownian step; 0 for none, as in the paper.
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        scene: Segmenter,
        size: float,
        rng: np.random.Generator,
        noise: ProcessNoise | None = None,
        base_rounds: int = 0,
    ) -> None:
        self._estimator = estimator
        self._scene = scene
        self._size = size
        self._rng = rng
        self._noise = noise or ProcessNoise.of(estimator.skeleton.name)
        self._base_rounds = base_rounds
        self._unit = estimator.skeleton.relative_size
        # base joints (K) in the camera frame; None before the animal is detected
        self._base: SE3 | None = None
        self._scale = np.ones(0)  # (K,) of the particles' bones
        self._weight = np.ones(0)  # (K,)
        self._last_ns = 0

    def step(self, frame: DepthFrame) -> tuple[Pose, float] | None:
        """One time step of Algorithm 3; the first frame with an animal initialises the particles.

        Args:
            frame: the next frame of the recording.

        Returns:
            The pose () in the camera frame and its expected mean joint error, mm; None before the
            animal is detected, and if no particle can be measured.
        """
        model = self._estimator.model
        camera_view = model.method.camera_view
        depths = frame.depth[None]
        dt = (frame.time_ns - self._last_ns) * 1e-9
        self._last_ns = frame.time_ns
        if self._base is None:
            found = self._estimator.estimate(depths, self._scene, self._size)
            return self._begin(found) if found.found[0] else None
        self._base = self._propagated(self._base, dt)
        crops = self._scene.extract(depths, self._size, camera_view=camera_view)
        if not crops.found[0]:
            return None
        crop_cameras = self._scene.crop_cameras(crops, camera_view)
        view = view_of(crop_cameras)
        T_view_camera = SE3(view.rotation[0], view.translation[0])
        T_camera_view = T_view_camera.inverse()
        images = ImageSet(crops.heights, crop_cameras, crops.moments)
        rotations, positions, score = self._measure(images, T_view_camera @ self._base)
        sigma = self._noise.sigma_mm * self._unit
        w = np.exp(-(score**2 - (score**2).min()) / (2.0 * sigma**2))
        self._weight = w / w.sum()
        pose = self._average(rotations, positions).moved(T_camera_view)
        self._base = T_camera_view @ SE3(rotations[:, 0], positions[:, 0])
        calibration = model.calibration
        mean = float(self._weight @ score)
        return pose, (calibration.offset + calibration.slope * mean) * self._size

    def _begin(self, found: Estimates) -> tuple[Pose, float]:
        k = self._noise.n_particles
        pose = found.chosen.pose
        root = pose.root
        self._base = SE3(
            *(np.repeat(part, k, axis=0) for part in (root.rotation, root.translation))
        )
        self._scale = np.repeat(pose.scale, k)
        self._weight = np.full(k, 1.0 / k)
        return pose[0], float(found.chosen.error_mm[0])

    def _propagated(self, base: SE3, dt: float) -> SE3:
        """Selection and propagation: draw particles from the cumulative weights, and move every
        base joint along a Brownian path of dt seconds (Eq. 7).
        """
        noise = self._noise
        k = noise.n_particles
        total = np.cumsum(self._weight)
        drawn = np.searchsorted(total, self._rng.random(k) * total[-1])
        self._scale = self._scale[drawn]
        self._weight = np.full(k, 1.0 / k)
        spread = np.array([noise.turn_rad] * 3 + [noise.shift_mm * self._size * self._unit] * 3)
        n_steps = max(1, int(np.ceil(dt / noise.delta_s - 1e-9)))
        # deviations are those of a whole step: the unit of time is delta_s
        steps = brownian_steps(self._rng, np.diag(spread**2), n_steps, k)
        base = SE3(base.rotation[drawn], base.translation[drawn])
        return brownian_ends(base, steps, 1.0, min(dt / noise.delta_s, float(n_steps)))

    def _measure(self, images: ImageSet, base: SE3) -> tuple[Array, Array, Array]:
        """All joints of the particles, regressed from their bases, and the metric's scores (K,).

        Rotations (K, J, 3, 3) and positions (K, J, 3) mm are in the view frame.
        """
        model = self._estimator.model
        cascade = model.cascade
        k = len(self._scale)
        candidates = Candidates.start(
            cascade.skeleton,
            np.zeros(k, np.int32),
            base.rotation,
            base.translation,
            self._scale,
            np.full(k, self._size),
        )
        first_round = len(cascade.forests[0]) - self._base_rounds
        some = replace(cascade, forests=[cascade.forests[0][first_round:], *cascade.forests[1:]])
        for _ in some.steps(images, candidates):
            pass
        self._scale = candidates.scale  # a base round may have corrected it
        scores = cascade.predict(model.metric, cascade.metric_samples(images, candidates))
        return candidates.rotations, candidates.positions, scores[:, 0].astype(float)

    def _average(self, rotations: Array, positions: Array) -> Pose:
        """Eq. 14 at the average itself: the base on SE(3), other joints on their axes."""
        weight = self._weight
        skeleton = self._estimator.skeleton
        base = SE3(rotations[:, 0], positions[:, 0])
        best = int(np.argmax(weight))
        root = SE3(base.rotation[best], base.translation[best])
        for _ in range(10):
            step = weight @ (root.inverse() @ base).log()
            root = root @ SE3.exp(step)
            if np.linalg.norm(step) < 1e-9:
                break
        angles = np.zeros((skeleton.n_joints, 3))
        for joint in skeleton.solved[1:]:
            home = rotations[:, skeleton.parents[joint]] @ skeleton.rest[joint]
            angles[joint] = weight @ so3.log(np.swapaxes(home, 1, 2) @ rotations[:, joint])
        return Pose(root, angles, np.asarray(weight @ self._scale))
