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

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import Candidates, ImageSet
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.geometry import SE3, brownian_ends, brownian_steps, so3
from liex_lab.recordings.frame import DepthFrame
from liex_lab.scene.height_maps import Segmenter, view_of

Array = NDArray[np.float64]

_AVERAGING_PASSES = 10


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
    def of(name: str, variant: str = "default", base_rounds: int = 0) -> ProcessNoise:
        """The parameters of an animal.

        Between two frames a fish moves and turns three times as far as a mouse, relative to its
        length. Those of the paper's variant were found by `liex train tracking --particles` on
        development sequences, see `searched`.

        Args:
            name: name of the skeleton; 'fish' has its own, all others the default.
            variant: variant of the regressors and the metric, 'default' or 'paper'.
            base_rounds: rounds of the base joint, see `ParticleFilter`.

        Returns:
            The parameters; the animal's own if none were searched for the variant.
        """
        own = ProcessNoise(turn_rad=0.45, shift_mm=12.0) if name == "fish" else ProcessNoise()
        return _SEARCHED.get((name, variant, base_rounds), own)

    @staticmethod
    def searched(name: str, variant: str, base_rounds: int) -> bool:
        """Whether the parameters of an animal and a variant were searched, not set by hand.

        Args:
            name: name of the skeleton.
            variant: variant of the regressors and the metric.
            base_rounds: rounds of the base joint.
        """
        return (name, variant, base_rounds) in _SEARCHED


# by animal, variant and rounds of the base joint: the best of a pattern search on the first 60
# frames of 16 sequences, `liex train tracking --particles --animal mouse --frames 60`
_SEARCHED: dict[tuple[str, str, int], ProcessNoise] = {
    ("mouse", "paper", 0): ProcessNoise(turn_rad=0.075, shift_mm=2.0, sigma_mm=1.0),
    ("mouse", "paper", 1): ProcessNoise(turn_rad=0.15, shift_mm=2.0, sigma_mm=1.0),
}


@dataclass
class _Particles:
    """Base joints (K) in the camera frame, their bones' scales (K,), and their weights (K,)."""

    base: SE3
    scale: Array
    weight: Array


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
        self._particles: _Particles | None = None
        self._last_ns = 0

    def step(self, frame: DepthFrame) -> tuple[Pose, float] | None:
        """One time step of Algorithm 3; the first frame with an animal initialises the particles.

        Args:
            frame: the next frame of the recording.

        Returns:
            The pose () in the camera frame and its expected mean joint error, mm; None before the
            animal is detected, and if no particle can be measured.
        """
        method = self._estimator.model.method
        depths = frame.depth[None]
        if self._particles is None:
            found = self._estimator.estimate(depths, self._scene, self._size)
            self._last_ns = frame.time_ns
            return self._begin(found) if found.found[0] else None
        self._select()
        self._propagate((frame.time_ns - self._last_ns) * 1e-9)
        self._last_ns = frame.time_ns
        crops = self._scene.extract(depths, self._size, camera_view=method.camera_view)
        if not crops.found[0]:
            return None
        crop_cameras = self._scene.crop_cameras(crops, method.camera_view)
        view = view_of(crop_cameras)
        T_view_camera = SE3(view.rotation[0], view.translation[0])
        images = ImageSet(crops.heights, crop_cameras, crops.moments)
        rotations, positions, score = self._measure(images, T_view_camera @ self._particles.base)
        sigma = self._noise.sigma_mm * self._unit
        w = np.exp(-(score**2 - (score**2).min()) / (2.0 * sigma**2))
        self._particles.weight = w / w.sum()
        pose = self._average(rotations, positions).moved(T_view_camera.inverse())
        self._particles.base = T_view_camera.inverse() @ SE3(rotations[:, 0], positions[:, 0])
        calibration = self._estimator.model.calibration
        mean = float(self._particles.weight @ score)
        return pose, (calibration.offset + calibration.slope * mean) * self._size

    @property
    def _unit(self) -> float:
        return self._estimator.skeleton.relative_size

    def _begin(self, found: Estimates) -> tuple[Pose, float]:
        k = self._noise.n_particles
        pose = found.chosen.pose
        base = SE3(
            np.repeat(pose.root.rotation, k, axis=0), np.repeat(pose.root.translation, k, axis=0)
        )
        self._particles = _Particles(base, np.repeat(pose.scale, k), np.full(k, 1.0 / k))
        return Pose(
            SE3(pose.root.rotation[0], pose.root.translation[0]), pose.angles[0], pose.scale[0]
        ), float(found.chosen.error_mm[0])

    def _select(self) -> None:
        """Selection: draw particles from the cumulative weights; all then have equal weights."""
        assert self._particles is not None
        p = self._particles
        k = self._noise.n_particles
        total = np.cumsum(p.weight)
        drawn = np.searchsorted(total, self._rng.random(k) * total[-1])
        self._particles = _Particles(
            SE3(p.base.rotation[drawn], p.base.translation[drawn]),
            p.scale[drawn],
            np.full(k, 1.0 / k),
        )

    def _propagate(self, dt: float) -> None:
        """Propagation: move every base joint along a Brownian path of dt seconds (Eq. 7)."""
        assert self._particles is not None
        noise = self._noise
        p = self._particles
        spread = np.array([noise.turn_rad] * 3 + [noise.shift_mm * self._size * self._unit] * 3)
        n_steps = max(1, int(np.ceil(dt / noise.delta_s - 1e-9)))
        # deviations are those of a whole step: the unit of time is delta_s
        steps = brownian_steps(self._rng, np.diag(spread**2), n_steps, len(p.scale))
        p.base = brownian_ends(p.base, steps, 1.0, min(dt / noise.delta_s, float(n_steps)))

    def _measure(self, images: ImageSet, base: SE3) -> tuple[Array, Array, Array]:
        """All joints of the particles, regressed from their bases, and the metric's scores (K,).

        Rotations (K, J, 3, 3) and positions (K, J, 3) mm are in the view frame.
        """
        assert self._particles is not None
        cascade = self._estimator.model.cascade
        model = self._estimator.model
        k = len(self._particles.scale)
        candidates = Candidates.start(
            cascade.skeleton,
            np.zeros(k, np.int32),
            base.rotation,
            base.translation,
            self._particles.scale,
            np.full(k, self._size),
        )
        for joint, rounds in zip(cascade.skeleton.solved, cascade.forests, strict=True):
            if joint:
                cascade.place(candidates, joint)
            for forest in rounds if joint else rounds[len(rounds) - self._base_rounds :]:
                samples = cascade.samples(images, candidates, [joint])
                cascade.apply(candidates, joint, cascade.predict(forest, samples))
        cascade.place_ends(candidates)
        self._particles.scale = candidates.scale  # a base round may have corrected it
        scores = cascade.predict(model.metric, cascade.metric_samples(images, candidates))
        return candidates.rotations, candidates.positions, scores[:, 0].astype(float)

    def _average(self, rotations: Array, positions: Array) -> Pose:
        """Eq. 14 at the average itself: the base on SE(3), other joints on their axes."""
        assert self._particles is not None
        weight = self._particles.weight
        skeleton = self._estimator.skeleton
        base = SE3(rotations[:, 0], positions[:, 0])
        best = int(np.argmax(weight))
        root = SE3(base.rotation[best], base.translation[best])
        for _ in range(_AVERAGING_PASSES):
            step = weight @ (root.inverse() @ base).log()
            root = root @ SE3.exp(step)
            if np.linalg.norm(step) < 1e-9:
                break
        angles = np.zeros((skeleton.n_joints, 3))
        for joint in skeleton.solved[1:]:
            home = rotations[:, skeleton.parents[joint]] @ skeleton.rest[joint]
            angles[joint] = weight @ so3.log(np.swapaxes(home, 1, 2) @ rotations[:, joint])
        return Pose(root, angles, np.asarray(weight @ self._particles.scale))
