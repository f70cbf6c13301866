"""Several animals of a kind in every frame: outlines that touch are explained by all bodies.

Animals that stand free are one component each, measured as a single animal is. A component of
several animals is cut into parts by lines in several directions, each part is measured as an
animal, and all bodies are rendered into one image, in which the nearest surface wins. The cost of
such an explanation is

    sum over observed pixels of min(|z_rendered - z_observed|, c) + c times the rendered pixels
    beside the component, over the observed pixels; c where nothing is rendered.

The best explanation is then improved alternately: every pixel goes to the body whose surface is
nearest to it in depth, or in the image where none is rendered, and each body is measured again on
its own pixels (hard expectation maximisation). A component that one body explains as well is one
animal, and one that a body high above the floor explains better than two is an animal on top of
another one, of which little is in view. One body is tried only where the component is hardly larger
than an animal, or several explain it badly. Only components of several animals pay for all this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from liex_lab.arrays import Mask, NDArray
from liex_lab.body.skeleton import VIEWS
from liex_lab.errors import EstimationError
from liex_lab.estimation.estimator import Detection, PoseEstimator
from liex_lab.recordings.frame import DepthFrame, has_readings, stacked
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene._blob_kernels import N_PX, SLOPE, back_slope, blob_moments
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.height_maps import ANIMAL_HEIGHTS, N_OBJECTS, HeightMaps, view_of
from liex_lab.tracking.observations import Array, Observations
from liex_lab.tracking.tracker import FrameTracker

Labels = NDArray[np.int8]  # of pixels: the animal's number, -1 for none

_SAME_SIZE = 0.1  # largest difference of the logarithms of the sizes of animals of one size
_CHANCE = 2.0  # that of equal animals, ordered in each frame, is 1.3 standard deviations
_TORN = 1.25  # pixels connected in blocks over those of one animal
_FEWEST = 5  # frames in which all stand apart
_LEAST_SHARE = 0.3  # area of an animal over that of the largest one in view
_LEAST_AREA = 0.5  # of an animal's visible part, over the usual area of the smallest one
_N_DIRECTIONS = 4  # of the cuts, in half a turn
_SWEEPS = 2
_MOST_OFF = 0.2  # of a pixel, in roots of the animal's area
_BETTER = 0.85  # cost of several bodies over that of one
_CLEAR = 0.4  # cost of several bodies, over c, below which one is not tried
_ON_TOP = 0.6  # how much higher than usual an animal on another one is, in its usual heights


@dataclass(frozen=True)
class JointTracker:
    """Measures several animals in each frame; single-frame observations of a frame name no animal.

    Attributes:
        scene: the segmenter of the recording's camera.
        trackers: one for each animal, the largest first; animals of one size share one.
        heights_mm: the usual mean height of each from the floor.
    """

    scene: BackgroundSubtraction
    trackers: tuple[FrameTracker, ...]
    heights_mm: tuple[float, ...]

    @staticmethod
    def prepare(alone: FrameTracker, sample: NDArray[np.float32], n_animals: int) -> JointTracker:
        """The tracker of several animals, from a sample of frames in which they stand apart.

        Args:
            alone: the tracker of one of them.
            sample: (n, H, W) float32 mm, frames spread over the recording, at the scene's stride.
            n_animals: how many animals to measure, 2 or more.

        Raises:
            EstimationError: fewer animals stand apart in all frames, or there is no still
                background.
        """
        scene = alone.scene
        if not isinstance(scene, BackgroundSubtraction):
            raise EstimationError(
                "several animals are measured before a still background, and this animal is "
                "separated by its distance; leave animal.count at 1"
            )
        area, size, images = _one_by_one(scene, sample, n_animals)
        if not len(images[0]):
            raise EstimationError(
                f"animal.count is {n_animals}, but hardly a frame of a sample shows as many "
                "animals apart (one that rests almost throughout is taken for the background); "
                "correct the number, or set animal.count to 'auto'"
            )
        smaller = -np.diff(np.log(size), axis=0)
        least = np.maximum(_SAME_SIZE, _CHANCE * smaller.std(axis=1))
        groups = np.append(0, np.cumsum(smaller.mean(axis=1) > least))
        trackers: list[FrameTracker] = []
        heights: list[float] = []
        for group in np.unique(groups):
            ranks = np.flatnonzero(groups == group)
            own = np.concatenate([images[rank][k :: len(ranks)] for k, rank in enumerate(ranks)])
            usual = replace(scene, area_mm2=float(np.median(area[ranks])))
            usual = replace(usual, volume_mm3=usual.usual_volume(own))
            tracker = FrameTracker.prepare(
                alone.estimator,
                usual,
                own,
                alone.spine_mm if alone.size_origin == "plan" else None,
                bridge_s=alone.bridge_s,
                adapt=alone.shape is not None,
            )
            heights += [usual.volume_mm3 / usual.area_mm2] * len(ranks)
            trackers += [replace(tracker, n_measured=n_animals)] * len(ranks)
        # the smallest animal and all of them together are equally far from this area
        middle = float(np.sqrt(area.min() * area.sum()))
        return JointTracker(replace(scene, area_mm2=middle), tuple(trackers), tuple(heights))

    @property
    def estimator(self) -> PoseEstimator:
        """The pose estimator of all animals."""
        return self.trackers[0].estimator

    @cached_property
    def bodies(self) -> list[FrameTracker]:
        """The trackers, each once."""
        return list({id(tracker): tracker for tracker in self.trackers}.values())

    @cached_property
    def body_of(self) -> NDArray[np.int64]:
        """(N,) which of the bodies is that of each animal."""
        return np.array([self.bodies.index(tracker) for tracker in self.trackers])

    @cached_property
    def usual_mm(self) -> Array:
        """The usual mean height of each body from the floor, mm."""
        return np.array([self.heights_mm[self.trackers.index(body)] for body in self.bodies])

    @cached_property
    def most_off_mm(self) -> float:
        """The largest distance of a pixel from the bodies that counts, mm."""
        return _MOST_OFF * float(np.sqrt(self.trackers[-1].scene.area_mm2))

    @cached_property
    def least_mm2(self) -> float:
        """The least area of a part of a component that is an animal, mm^2."""
        return _LEAST_AREA * min(tracker.scene.area_mm2 for tracker in self.trackers)

    def observe(self, frames: Sequence[DepthFrame]) -> list[Observations]:
        """The pose hypotheses of consecutive frames, with the body of each animal.

        Args:
            frames: at least one.

        Returns:
            For each animal, observations of n frames, arena frame: two hypotheses of each of N
            components, of which any may be that animal. Animals of one size share them.
        """
        depths = stacked(frames)
        times = np.array([frame.time_ns for frame in frames], np.int64)
        with threads(len(frames) > 1):
            crops = self.components(depths)
            parts = self._parts(crops, depths)
            cleared = self.scene.cleared(depths)
            found = {}
            for body in self.bodies:
                observed = Observations.empty(self.estimator.skeleton, times, len(self.trackers))
                observed.has_depth[:] = [has_readings(depth) for depth in depths]
                observed.repeats[:] = [frame.repeats for frame in frames]
                observed.objects[:] = crops.objects[: len(frames)]
                self._measure(body, observed, parts, depths, cleared)
                if body.noisy:
                    observed.forget(observed.repeats)
                found[id(body)] = observed
        return [found[id(tracker)] for tracker in self.trackers]

    def components(self, depths: NDArray[np.float32]) -> HeightMaps:
        """The components of depth images (n, H, W) mm: N_OBJECTS n rows, component by component."""
        return self.scene.extract(
            depths, self._size, camera_view=self.camera_view, n_candidates=N_OBJECTS
        )

    @property
    def camera_view(self) -> bool:
        """Whether heights are measured from behind the animal, see `BackgroundSubtraction`."""
        return self.estimator.model.method.camera_view

    @property
    def _size(self) -> float:
        return self.trackers[0].size if self.estimator.model.method.session_size else 1.0

    def _measure(
        self,
        body: FrameTracker,
        observed: Observations,
        parts: HeightMaps,
        depths: NDArray[np.float32],
        cleared: NDArray[np.float32],
    ) -> None:
        """Set the hypotheses of all parts (N n rows, part by part) with the body of one animal."""
        n = len(observed)
        whole = self.candidates(body, parts)
        detections = [whole[k * n : (k + 1) * n] for k in range(len(self.trackers))]
        hypotheses = self.estimator.both_directions(detections, body.size)
        poses = [body.put(observed, h, some, depths) for h, some in enumerate(hypotheses)]
        body.put_agreement(observed, hypotheses, poses, cleared)

    def candidates(self, body: FrameTracker, parts: HeightMaps) -> Detection:
        """The candidate poses of a body in each part (k rows)."""
        cameras = self.scene.crop_cameras(parts, self.camera_view)
        return self.estimator.candidates(parts, cameras, body.size)

    def _parts(self, crops: HeightMaps, depths: NDArray[np.float32]) -> HeightMaps:
        """The height map of each animal, as far as it is in view: N n rows, part by part.

        crops are the components of n frames, N_OBJECTS n rows.
        """
        wanted, n = len(self.trackers), len(depths)
        right = self._are_animals(crops).reshape(N_OBJECTS, n)
        area = crops.blobs.area_mm2.reshape(N_OBJECTS, n)
        order = np.argsort(np.where(right, -area, 0.0), axis=0, kind="stable")[:wanted]
        rows = order * n + np.arange(n)
        there = np.take_along_axis(right, order, axis=0)
        parts = crops[rows.ravel()]
        parts.n_px[~there.ravel()] = 0
        missing = np.where(there[0], wanted - there.sum(axis=0), 0)
        shown_px = parts.blobs.n_px[:n] * parts.step[:n] ** 2
        # blocks connect animals that pixels separate: the largest component shows one of them
        torn = np.flatnonzero((missing > 0) & (parts.n_px[:n] > _TORN * shown_px))
        if len(torn):
            others = self._beside(parts[torn], depths[torn])
            found = self._are_animals(others)
            parts.put(torn[found] + n * (wanted - 1), others[found])
            missing[torn[found]] -= 1
        for k in np.unique(missing[missing > 0]):  # all in the largest component
            some = np.flatnonzero(missing == k)
            split, accepted = self._explain(crops[rows[0, some]], int(k) + 1)
            for j in range(k + 1):
                at = some[accepted] + n * (0 if j == 0 else wanted - 1 - k + j)
                parts.put(at, split[j * len(some) : (j + 1) * len(some)][accepted])
        return parts

    def _are_animals(self, crops: HeightMaps) -> Mask:
        """Which components (n,) are as large and high as one of the animals or several of them."""
        area = np.where(crops.found, crops.blobs.area_mm2, 0.0)
        right = area >= self.least_mm2
        if self.scene.view.frame == VIEWS[0]:  # swimming animals are at any height
            height = crops.blobs.volume_mm3 / np.maximum(area, 1e-9)
            least, most = ANIMAL_HEIGHTS
            right &= height > least * min(self.heights_mm)
            right &= height < (most + 1.0) * max(self.heights_mm)  # on top of another one
        return np.asarray(right)

    def _beside(self, crops: HeightMaps, depths: NDArray[np.float32]) -> HeightMaps:
        """What else (q rows) is in frames (q, H, W) mm without the components that were found."""
        scene = self.scene
        left = depths[:, :: scene.stride, :: scene.stride].copy()
        for image, mask, step in zip(left, scene.animal_masks(crops), crops.step, strict=True):
            own = cv2.dilate(mask.astype(np.uint8), np.ones((2 * step // scene.stride + 1,) * 2))
            image[own > 0] = scene.background[own > 0]
        return scene.extract(left, self._size, camera_view=self.camera_view)

    def _explain(self, blobs: HeightMaps, m: int) -> tuple[HeightMaps, Mask]:
        """Cut components (q rows) into the parts of m animals each: m q rows, part by part; and
        whether (q,) they are so many animals.
        """
        q, n_bodies = len(blobs.n_px), len(self.bodies)
        rows = np.arange(q)
        observed = self.depth_of(blobs)
        labels, bodies = self._cuts(blobs, m)
        on_floor = np.zeros(bodies.shape[:2])
        cost, drawn, shown = self._tried(blobs, observed, labels, bodies, on_floor)
        best = cost.argmin(axis=1)
        kept_cost, kept, shown = cost[rows, best], labels[rows, best], shown[rows, best]
        now = kept
        for _ in range(_SWEEPS):
            now = self._owners(observed, drawn[shown], now)
            again, drawn, fresh = self._tried(
                blobs, observed, now[:, None], bodies[:, :1], on_floor[:, :1]
            )
            better = again[:, 0] < kept_cost
            kept_cost = np.where(better, again[:, 0], kept_cost)
            kept = np.where(better[:, None, None], now, kept)
            shown = fresh[:, 0]
        largest_mm2 = max(body.scene.area_mm2 for body in self.bodies)
        several = (kept_cost < _CLEAR) & (blobs.blobs.area_mm2 > _TORN * largest_mm2)
        on_top, up_mm = np.zeros(q, np.bool_), np.zeros((m, q))
        if len(some := np.flatnonzero(~several)):
            labels, bodies, raised_mm = self._with_one_body(blobs[some], m)
            cost, _, _ = self._tried(blobs[some], observed[some], labels, bodies, raised_mm)
            several[some] = kept_cost[some] < _BETTER * cost[:, :n_bodies].min(axis=1)
            upper = np.arange(len(some)), n_bodies + cost[:, n_bodies:].argmin(axis=1)
            on_top[some] = _BETTER * cost[upper] < kept_cost[some]
            up_mm[0, some] = np.where(on_top[some], raised_mm[upper], 0.0)
            kept[on_top] = labels[upper][on_top[some]]
        mine = np.concatenate([kept == j for j in range(m)])
        split = self.cut(HeightMaps.join([blobs] * m), mine, up_mm.ravel())
        enough = split.blobs.area_mm2.reshape(m, q) > 0.6 * self.least_mm2
        split.n_px[~enough.ravel()] = 0
        return split, on_top | several & enough.all(axis=0)

    def _with_one_body(self, blobs: HeightMaps, m: int) -> tuple[Labels, NDArray[np.int64], Array]:
        """Explain components (q rows) by one body, each of B in turn: all of it is one animal, or
        shows an animal on top of another one, of which little is in view.

        The upper animal has the highest pixels, as many as usual, and is measured from so far above
        the floor that its mean height is the usual one.

        Returns:
            Labels (q, 2 B, S, S), 0 on the animal; the body (q, 2 B, m) of each part, -1 for none,
            and how far (q, 2 B) the animal is raised, mm.
        """
        n_bodies = len(self.bodies)
        labels = np.where(blobs.heights > 0, np.int8(0), np.int8(-1))[:, None]
        labels = labels.repeat(2 * n_bodies, axis=1)
        bodies = np.full((*labels.shape[:2], m), -1)
        bodies[:, :n_bodies, 0] = np.arange(n_bodies)
        up_mm = np.zeros(labels.shape[:2])
        for i, heights in enumerate(blobs.heights if m == 2 and not self.camera_view else ()):
            ordered = np.sort(heights[heights > 0])
            for k, body in enumerate(self.bodies):
                usual_mm = self.usual_mm[k]
                lower = max(1.0 - body.scene.area_mm2 / blobs.blobs.area_mm2[i], 0.0)
                least = ordered[int(np.ceil(lower * (len(ordered) - 1)))]
                raised_mm = ordered[ordered >= least].mean() / 16.0 - usual_mm
                if raised_mm > _ON_TOP * usual_mm:
                    labels[i, n_bodies + k, heights > 0] = heights[heights > 0] < least
                    bodies[i, n_bodies + k, 0], up_mm[i, n_bodies + k] = k, raised_mm
        return labels, bodies, up_mm

    def _cuts(self, blobs: HeightMaps, m: int) -> tuple[Labels, NDArray[np.int64]]:
        """Labels (q, P, S, S) of the parts in P ways of cutting, and the body (q, P, m) of each."""
        areas = np.array([tracker.scene.area_mm2 for tracker in self.trackers])
        # of animals of two sizes either may be on either side: on a floor, volumes decide
        chosen = np.arange(len(areas)) if len(areas) == m else np.arange(m)
        n_sides = 1 if len(self.bodies) == 1 else 2
        n_ways = _N_DIRECTIONS * (n_sides if self.camera_view else 1)
        angles = np.arange(_N_DIRECTIONS * n_sides) * np.pi / _N_DIRECTIONS
        share = np.cumsum(areas[chosen]) / areas[chosen].sum()
        volumes = (areas * self.heights_mm)[chosen]
        labels = np.full((len(blobs.n_px), n_ways, *blobs.heights.shape[1:]), -1, np.int8)
        for own, heights in zip(labels, blobs.heights, strict=True):
            v, u = np.nonzero(heights > 0)
            pixels = np.array([u, v], float)
            axes = np.linalg.eigh(np.cov(pixels))[1]  # across and along
            along = (axes @ (np.cos(angles), np.sin(angles))).T @ pixels
            last = (share[:-1] * (len(u) - 1)).astype(int)
            cuts = np.partition(along, last, axis=1)[:, last].T
            parts = (along > cuts[..., None]).sum(axis=0, dtype=np.int8)
            if len(parts) > n_ways:
                inside = heights[v, u].astype(float)
                of_first = (parts == 0) @ inside / inside.sum()
                off = np.abs(of_first - volumes[0] / volumes.sum()).reshape(n_sides, n_ways)
                parts = parts.reshape(n_sides, n_ways, -1)[off.argmin(axis=0), np.arange(n_ways)]
            own[:, v, u] = parts
        return labels, np.tile(self.body_of[chosen], (len(labels), n_ways, 1))

    def cut(self, parts: HeightMaps, mine: Mask, up_mm: Array) -> HeightMaps:
        """The same height maps (k rows) without the pixels that are not `mine` (k, S, S), each
        measured from up_mm (k,) above the floor; in place.
        """
        parts.heights[:] *= mine
        behind_mm = self.scene.view.behind_mm if self.camera_view else 0.0
        lift = -up_mm
        if self.camera_view:  # heights are measured from behind the middle of each part
            n_px = np.maximum(mine.sum(axis=(1, 2)), 1)
            lift += behind_mm - parts.heights.sum(axis=(1, 2)) / 16.0 / n_px
        moved = np.flatnonzero(lift)
        raised = parts.heights[moved] + (16.0 * lift[moved])[:, None, None]
        parts.heights[moved] = np.where(mine[moved], np.maximum(raised, 1), 0)
        parts.distance[:] += lift
        camera = self.scene.camera
        in_parallel(
            _measure_parts,
            len(parts.n_px),
            self.scene.planes(parts, self.camera_view),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            self.scene.view_rotation(self.camera_view),
            behind_mm,
            parts.rows,
        )
        return parts

    def _tried(
        self,
        blobs: HeightMaps,
        observed: NDArray[np.float32],
        labels: Labels,
        bodies: NDArray[np.int64],
        raised_mm: Array,
    ) -> tuple[Array, NDArray[np.float32], NDArray[np.int64]]:
        """Explain components (q rows), whose depth is `observed`, in P ways, by the parts `labels`
        (q, P, S, S), each with its body (q, P, m), -1 for none, the first of them raised (q, P) mm.

        Returns:
            The cost (q, P) over c, infinite if a part has no pose; the rendered bodies (r, S, S)
            mm, the last of them empty; and which of them (q, P, m) is that of each part.
        """
        q, p, m = bodies.shape
        ways = labels.reshape(q * p, *labels.shape[2:])
        which, part, way = np.nonzero(
            np.arange(len(self.bodies))[:, None, None] == bodies.reshape(q * p, m).T
        )
        up_mm = np.where(part == 0, raised_mm.ravel()[way], 0.0)
        parts = self.cut(blobs[way // p], ways[way] == part[:, None, None], up_mm)
        drawn = np.zeros((len(way) + 1, *ways.shape[1:]), np.float32)
        for k, body in enumerate(self.bodies):
            rows = slice(*np.searchsorted(which, (k, k + 1)))
            self.draw(body, parts[rows], drawn[rows])
        shown = np.full((q * p, m), -1)
        shown[way, part] = np.arange(len(way))
        cost = self.costs(observed, drawn, shown)
        cost[way[~parts.found]] = np.inf
        cost[(shown < 0).all(axis=1)] = np.inf
        return cost.reshape(q, p), drawn, shown.reshape(q, p, m)

    def costs(
        self, observed: NDArray[np.float32], drawn: NDArray[np.float32], shown: NDArray[np.int64]
    ) -> Array:
        """The costs (q P,) of explaining depth (q, S, S) mm in P ways each by bodies (r, S, S) mm,
        those numbered shown (q P, m), see the module.
        """
        cost = np.empty(len(shown))
        in_parallel(_explained, len(shown), observed, drawn, shown, self.most_off_mm, cost)
        return cost

    def draw(self, body: FrameTracker, parts: HeightMaps, drawn: NDArray[np.float32]) -> None:
        """Render the best pose of a body in each part (k rows) into `drawn` (k, S, S) mm."""
        found = self.candidates(body, parts)
        some = np.flatnonzero(found.usable)
        if len(some):
            found = found[some]
            pose = self.estimator.pick(found, body.size).pose
            pose = pose.moved(view_of(found.crop_cameras).inverse())
            if body.shape is not None:
                pose = body.shape.corrected(self.estimator, pose, body.size)
            pose = pose.moved(self.scene.floor.T_arena_camera)
            drawn[some] = body.body.rendered(pose, found.crops, self.scene)

    def depth_of(self, blobs: HeightMaps) -> NDArray[np.float32]:
        """Depth (q, S, S) mm of components, 0 outside."""
        size = blobs.heights.shape[1]
        a, b, c = self.scene.planes(blobs, self.camera_view).T[:, :, None, None]
        pixel = np.arange(size) * blobs.step[:, None]
        u = (blobs.origin[:, :1] + pixel)[:, None, :]
        v = (blobs.origin[:, 1:] + pixel)[:, :, None]
        up = 1.0 - blobs.heights / 16.0 / blobs.distance[:, None, None]
        return np.where(blobs.heights > 0, up / (a * u + b * v + c), 0.0).astype(np.float32)

    @staticmethod
    def _owners(
        observed: NDArray[np.float32], drawn: NDArray[np.float32], labels: Labels
    ) -> Labels:
        """Labels (q, S, S) of pixels of depth `observed` by the nearest of bodies (q, m, S, S)."""
        out = labels.copy()
        away = np.empty(drawn.shape, np.float32)
        for at in np.ndindex(drawn.shape[:2]):
            away[at] = cv2.distanceTransform((drawn[at] == 0).astype(np.uint8), cv2.DIST_L2, 3)
        in_parallel(_nearest_body, len(out), observed, drawn, away, out)
        return out


def _one_by_one(
    scene: BackgroundSubtraction, sample: NDArray[np.float32], n_animals: int
) -> tuple[Array, Array, list[NDArray[np.float32]]]:
    """The animals of a sample in the k frames in which all stand apart, the largest first in each:
    usual areas (N,) mm^2, sizes (N, k), and images (k, H, W) mm of each without the others.

    Size is the volume of an animal on the floor, which posture changes less than its area, and the
    area of a swimming one.
    """
    crops = scene.extract(sample, 1.0, n_candidates=n_animals)
    n = len(sample)
    rows = np.arange(n_animals)[:, None] * n + np.arange(n)
    blobs = crops.blobs
    height = blobs.volume_mm3 / np.maximum(blobs.area_mm2, 1e-9)
    animals = crops.found.copy()
    if scene.view.frame == VIEWS[0]:
        animals &= height > ANIMAL_HEIGHTS[0] * np.median(height[:n][crops.found[:n]])
    animals &= crops.n_px < _TORN * blobs.n_px * crops.step**2
    animals &= blobs.area_mm2 > _LEAST_SHARE * np.tile(blobs.area_mm2[rows].max(axis=0), n_animals)
    apart = np.flatnonzero(animals[rows].all(axis=0))
    if len(apart) < _FEWEST:
        return np.ones(n_animals), np.ones((n_animals, 1)), [sample[:0]] * n_animals
    on_floor = scene.view.frame == VIEWS[0]
    size = (blobs.volume_mm3 if on_floor else blobs.area_mm2)[rows[:, apart]]
    order = np.argsort(-size, axis=0, kind="stable")
    square = np.ones((7, 7), np.uint8)
    masks = np.array(
        [scene.animal_masks(crops[rows[k, apart]]) for k in range(n_animals)], np.uint8
    )
    images = []
    for rank in range(n_animals):
        left = sample[apart].copy()
        for i, k in enumerate(order[rank]):
            others = cv2.dilate(np.delete(masks[:, i], k, axis=0).max(axis=0), square) > 0
            others &= masks[k, i] == 0
            left[i] = np.where(others, scene.background, left[i])
        images.append(left)
    area, size = (
        np.take_along_axis(values, order, axis=0)
        for values in (blobs.area_mm2[rows[:, apart]], size)
    )
    return np.median(area, axis=1), size, images


@kernel(nogil=True)
def _measure_parts(planes, intrinsics, rotation, behind_mm, crops, start, stop):
    """Fill the moments and numbers of pixels of height maps (n rows of `CropRows`)."""
    for k in range(start, stop):
        heights, origin, step = crops.heights[k], crops.origin[k], crops.step[k]
        moments = crops.moments[k]
        distance = crops.distance[k]
        blob_moments(heights, origin, step, planes[k], intrinsics, rotation, distance, moments)
        if behind_mm > 0.0 and moments[N_PX] > 0:
            moments[SLOPE] = back_slope(heights, origin, step, intrinsics, distance, moments)
        crops.n_px[k] = int(moments[N_PX] * step * step)


@kernel(nogil=True)
def _nearest_body(observed, drawn, away, out, start, stop):
    """Fill labels (q, S, S) of pixels of depth (q, S, S) mm with the nearest of the bodies (q, m,
    S, S) mm in depth, or, where none is drawn, in the image, `away` (q, m, S, S) px.
    """
    for i in range(start, stop):
        for v in range(observed.shape[1]):
            for u in range(observed.shape[2]):
                least = np.inf
                for j in range(drawn.shape[1] if observed[i, v, u] > 0 else 0):
                    off = 1e3 * (1.0 + away[i, j, v, u])
                    if drawn[i, j, v, u] > 0:
                        off = abs(drawn[i, j, v, u] - observed[i, v, u])
                    if off < least:
                        least, out[i, v, u] = off, j


@kernel(nogil=True)
def _explained(observed, drawn, shown, most_mm, out, start, stop):
    """Fill the costs (q P,), over c, of explaining depth (q, S, S) mm by rendered bodies (r, S, S)
    mm, those numbered shown (q P, m), see the module.
    """
    n_ways = len(shown) // len(observed)
    for k in range(start, stop):
        depth = observed[k // n_ways]
        cost, n_px = 0.0, 0
        for v in range(depth.shape[0]):
            for u in range(depth.shape[1]):
                nearest = np.inf
                for body in shown[k]:
                    if drawn[body, v, u] > 0:
                        nearest = min(nearest, drawn[body, v, u])
                if depth[v, u] > 0:
                    n_px += 1
                    cost += min(abs(nearest - depth[v, u]), most_mm)
                elif nearest < np.inf:
                    cost += most_mm
        out[k] = cost / (most_mm * max(n_px, 1))
