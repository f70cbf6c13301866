"""Body shape of the animal of a session: its width and height, and the pose error that they cause.

Forests learn from bodies of one family; on another build their poses have the same error in every
frame, since the mid-axis is not visible: a body that is flatter than usual lies higher in its skin,
a blunt one begins elsewhere in its outline. All frames of a session together (the mean
cross-sections) determine the build, and with it that error. A linear map fitted by ridge regression
(Hoerl and Kennard 1970) on rendered mini-sessions of a wide family of builds,

    y = W^T x + b,    x the clues of a session, y its build and its poses' mean error,

maps the clues to the mean of true minus estimated joints in the base's frame, over the length, and
to the logarithms of half width and half height over the average animal's at five positions.

A linear map extrapolates: on a body unlike those of the training, such as one with a sharper back,
it can be wrong by a multiple. If a clue lies far outside the training, the map is not used. Such a
body is as wide as its outline, and as high as an average animal of that width, with the standard
deviations that this leaves: the height of a body that swims is not visible from above.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.refine import Array, ridge_regression
from liex_lab.geometry import SE3
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.height_maps import mm_per_px

N_STATIONS = 22
N_LATERAL = 24
_FROM, _TO = -0.10, 1.10  # along the chain: a body extends past both its ends
_HARDLY = 0.15  # of the frames show a cell: rarer readings are other objects and torn edges
_PLACES = (
    0.05,
    0.45,
    0.65,
    0.85,
)  # over the half width: positions at which the back's decline is measured
_MARGIN = 2  # stations at either end that are past the body


def cross_sections(
    skeleton: Skeleton, pose: Pose, heights: NDArray[np.int16], crop_cameras: Array, size: float
) -> tuple[Array, Array, float]:
    """Mean cross-sections over the frames of one animal, lengths over the animal's own.

    Args:
        skeleton: of the animal, one chain with a tube as its surface.
        pose: (n) poses, view frame, at least one.
        heights: (n, H, W) int16 height maps, 1/16 mm.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        size: the animal's size over home size.

    Returns:
        The share (S, T) of the frames in which the animal is at a station and a lateral position,
        both sides together; its mean height (S, T) over the mid-axis, if it is there; and the
        distance between lateral positions.
    """
    joints = pose.joints(skeleton)
    n = len(joints)
    ends = skeleton.reach / skeleton.length
    at = np.linspace(_FROM, _TO, N_STATIONS)
    bone = np.clip(np.searchsorted(ends, at, side="right") - 1, 0, len(ends) - 2)
    share = ((at - ends[bone]) / (ends[bone + 1] - ends[bone]))[:, None]
    along = joints[:, bone + 1] - joints[:, bone]
    # on the mid-axis, and unit vectors across it in the image
    points = np.ascontiguousarray(joints[:, bone] + share * along)
    sideways = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    sideways /= np.maximum(np.linalg.norm(sideways, axis=-1, keepdims=True), 1e-9)
    # the broadest animal is narrower
    reach = 1.75 * float(BodyShape.default(skeleton).half_width.max()) * size
    lateral = (np.arange(N_LATERAL) + 0.5) / N_LATERAL * reach
    covered = np.empty((n, N_STATIONS, N_LATERAL))
    height = np.empty_like(covered)
    in_parallel(
        kernels.read_across, n, heights, crop_cameras, points, sideways, lateral, covered, height
    )
    length = skeleton.length * size
    shown = covered.sum(axis=0)
    mean = (covered * height).sum(axis=0) / np.maximum(shown, 0.5) / length
    return shown / n, mean, reach / N_LATERAL / length


def _grouped(values: Array, weight: Array, n: int) -> Array:
    """Weighted means of values (S, K) over n groups of neighbouring stations, (n K,)."""
    groups = np.array_split(np.arange(_MARGIN, N_STATIONS - _MARGIN), n)
    return np.concatenate(
        [weight[g] @ values[g] / max(float(weight[g].sum()), 1e-9) for g in groups]
    )


PLACES = (0.1, 0.25, 0.4, 0.6, 0.8)  # of the body's length
_RIDGE = 0.03  # of the clues' variance
_FOLDS = 5
_TAIL = 0.005  # quantile of a clue in training at which it is clipped
# of a clue's range in training: bodies of its families stay within half of this
_FAR = 0.25
# standard deviations for a body unlike those of the training: of the logarithm of its height, and
# of the joints' height over the length: the root mean square over four foreign fish
_UNLIKE_SD = 0.35
_UNLIKE_UNSEEN = 0.033
_BACKS = 8  # groups of stations in which the height of the back is a clue


def session_clues(
    skeleton: Skeleton, pose: Pose, heights: NDArray[np.int16], crop_cameras: Array, size: float
) -> Array:
    """Evidence about the animal's build from all frames of a session.

    It is the half widths, the height of the back over the mid-axis and its decline towards its edge
    in groups of stations, the blur of the outline, and the size of a pixel and that of the bones.

    Args:
        skeleton: of the animal, one chain with a tube as its surface.
        pose: (n) estimated poses, view frame, at least one.
        heights: (n, H, W) int16 height maps, 1/16 mm.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        size: the animal's size over home size used for the poses.

    Returns:
        (F,) numbers, lengths over the animal's own.
    """
    covered, across, step = cross_sections(skeleton, pose, heights, crop_cameras, size)
    width = covered.sum(axis=1) * step
    # thinner, a station shows nothing
    least = 0.05 * BodyShape.default(skeleton).half_width.max() / skeleton.length
    lateral = (np.arange(N_LATERAL) + 0.5) * step
    for t in range(1, N_LATERAL):  # cells that are rarely visible continue the back level
        across[:, t] = np.where(covered[:, t] < _HARDLY, across[:, t - 1], across[:, t])
    back = np.zeros((N_STATIONS, len(_PLACES)))
    for s in np.flatnonzero(width > least):
        back[s] = np.interp(np.array(_PLACES) * width[s], lateral, across[s])
    torn = (covered > _HARDLY) & (covered < 1.0 - _HARDLY)
    return np.concatenate(
        [
            width,
            _grouped(back[:, :1], width, _BACKS),
            _grouped(back[:, :1] - back[:, 1:], width, 6),
            [torn.mean()],
            [float(np.median(mm_per_px(crop_cameras))) / (skeleton.length * size)],
            [float(np.log(np.median(pose.scale) / size))],
        ]
    )


@dataclass(frozen=True)
class ShapePrior:
    """The regression from a session's clues to the animal's build and its poses' mean error.

    Labels are the mean error of the joints (3 J, over the length, in the base's frame), and the
    logarithms of half width and of half height over the average animal's at `PLACES`.

    Attributes:
        bounds: (2, F) the least and the most of each clue, beyond which it is clipped.
        table: (F + 1, K) weights of the clues, and the constant.
        spread: (K,) residual standard deviation of each label, by cross-fitting.
        unseen: residual standard deviations, over the length, of the joints' height and of their
            position along the body, on builds that are not in the training data either.
        model: fingerprint of the pose model whose errors these are.
    """

    bounds: Array
    table: Array
    spread: Array
    unseen: tuple[float, float] = (0.0, 0.0)
    model: str = ""

    @staticmethod
    @cache
    def of(name: str) -> "ShapePrior | None":
        """The prior of an animal by the name of its skeleton; None if absent."""
        path = Path(__file__).with_name("shapes") / f"{name}.npz"
        return ShapePrior.load(path) if path.is_file() else None

    @staticmethod
    def load(path: Path) -> "ShapePrior":
        """Read a prior that `save` wrote."""
        with np.load(path) as held:
            height, along = held["unseen"].tolist()
            return ShapePrior(
                held["bounds"].astype(float),
                held["table"].astype(float),
                held["spread"].astype(float),
                (height, along),
                str(held["model"]),
            )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the file, in single precision except for `unseen`."""
        return {
            "bounds": self.bounds.astype(np.float32),
            "table": self.table.astype(np.float32),
            "spread": self.spread.astype(np.float32),
            "unseen": np.array(self.unseen),
            "model": np.array(self.model),
        }

    @staticmethod
    def fit(clues: Array, labels: Array) -> "ShapePrior":
        """Fit the regression to sessions of known animals.

        Args:
            clues: (n, F) of n sessions.
            labels: (n, K) of them.

        Returns:
            The prior; `unseen` is zero until measured on other builds.
        """
        bounds = np.quantile(clues, [_TAIL, 1.0 - _TAIL], axis=0)
        x = np.clip(clues, *bounds)
        fold = np.arange(len(x)) % _FOLDS
        left = np.empty_like(labels)
        for k in range(_FOLDS):
            weights, constant = ridge_regression(x[fold != k], labels[fold != k], _RIDGE, 1e-9)
            left[fold == k] = labels[fold == k] - (x[fold == k] @ weights + constant)
        table = np.vstack(ridge_regression(x, labels, _RIDGE, 1e-9))
        return ShapePrior(bounds, table, left.std(axis=0))

    def is_unlike(self, clues: Array) -> bool:
        """Whether clues (F,) lie so far outside the training that `predict` extrapolates."""
        low, high = self.bounds
        beyond = np.maximum(low - clues, clues - high)
        return bool((beyond > _FAR * (high - low)).any())

    def unseen_of(self, unlike: bool) -> tuple[float, float]:
        """`unseen`, or larger for a body unlike those of the training."""
        return (_UNLIKE_UNSEEN, self.unseen[1]) if unlike else self.unseen

    def predict(self, clues: Array) -> Array:
        """The labels of sessions.

        Args:
            clues: (..., F).

        Returns:
            (..., K).
        """
        # a product's last bits depend on the machine
        return np.asarray(
            (np.clip(clues, *self.bounds) @ self.table[:-1] + self.table[-1]).round(9)
        )


def outline_labels(skeleton: Skeleton, clues: Array) -> Array:
    """Labels of a body unlike those of the training, from its outline alone.

    Its width is that of the outline and its height that of an average animal of the same width. Its
    joints are moved up or down until the back of that body lies where the back is visible.

    Args:
        skeleton: of the animal, one chain with a tube as its surface.
        clues: (F,), see `session_clues`.

    Returns:
        (K,), see `labels_of`.
    """
    average = BodyShape.default(skeleton)
    at = np.linspace(_FROM, _TO, N_STATIONS)
    groups = np.array_split(np.arange(_MARGIN, N_STATIONS - _MARGIN), _BACKS)
    trunk = slice(1, _BACKS // 2 + 1)  # the groups that are widest
    middles = np.array([at[group].mean() for group in groups])[trunk]

    def usual(values: Array, places: Array) -> Array:
        return np.interp(places, skeleton.surface["stations"], values) / skeleton.length

    places = np.array(PLACES)
    width = np.interp(places, at, clues[:N_STATIONS]) / usual(average.half_width, places)
    broad = float(
        np.median(np.interp(middles, at, clues[:N_STATIONS]) / usual(average.half_width, middles))
    )
    back = clues[N_STATIONS : N_STATIONS + _BACKS][trunk]
    offset = np.zeros((skeleton.n_joints, 3))
    offset[:, 2] = np.median(back - broad * usual(average.half_height, middles))
    return labels_of(offset, np.clip(width, 0.5, 2.0), np.full(len(places), broad)).round(9)


def labels_of(offset: ArrayLike, width: ArrayLike, height: ArrayLike) -> Array:
    """Labels of a session for `ShapePrior`.

    Args:
        offset: (J, 3) mean of true minus estimated joints, base frame, over the length.
        width: (P,) half widths over the average animal's at `PLACES`.
        height: (P,) half heights likewise.
    """
    return np.concatenate([np.ravel(offset), np.log(width), np.log(height)])


@dataclass(frozen=True)
class Build:
    """An animal's build relative to the average one's, and the error of its estimated poses.

    Attributes:
        offset: (J, 3) added to the joints, base frame, over the animal's length.
        width: (P,) half widths over the average animal's of that length, at `PLACES`.
        height: (P,) half heights likewise.
        width_sd: (P,) standard deviations of the logarithms of `width`.
        height_sd: (P,) of `height`.
        unseen: residual standard deviations, over the length, of the joints' height and of their
            position along the body.
    """

    offset: Array
    width: Array
    height: Array
    width_sd: Array
    height_sd: Array
    unseen: tuple[float, float]

    @staticmethod
    def of(prior: ShapePrior, labels: Array, unlike: bool = False) -> "Build":
        """The build stated by labels, with the uncertainty of one estimated from clues.

        Args:
            prior: of the animal.
            labels: (K,), see `labels_of`.
            unlike: whether the body is unlike those of the training.
        """
        p = len(PLACES)
        return Build(
            labels[: -2 * p].reshape(-1, 3),
            np.exp(labels[-2 * p : -p]),
            np.exp(labels[-p:]),
            prior.spread[-2 * p : -p],
            np.full(p, _UNLIKE_SD) if unlike else prior.spread[-p:],
            prior.unseen_of(unlike),
        )

    def corrected(self, skeleton: Skeleton, pose: Pose, size: float) -> Pose:
        """The poses without the mean error of such a body.

        Args:
            skeleton: of the animal, one chain.
            pose: (n) estimated poses in any frame; rows that are not finite are unchanged.
            size: the animal's size over home size.
        """
        rows = np.isfinite(pose.scale)
        if not rows.any():
            return pose
        some = pose[rows]
        rotation = some.root.rotation
        moved = some.joints(skeleton) + skeleton.length * size * np.einsum(
            "nij,kj->nki", rotation, self.offset
        )
        right = Pose.from_joints(skeleton, moved, rotation[..., 2])
        whole = Pose(
            SE3(pose.root.rotation.copy(), pose.root.translation.copy()),
            pose.angles.copy(),
            pose.scale.copy(),
        )
        whole.put(rows, right)
        return whole


def built(
    skeleton: Skeleton,
    width: Array | Sequence[float],
    height: Array | Sequence[float],
    places: Sequence[float] = PLACES,
) -> Surface:
    """The body of an animal whose build is not the average.

    Args:
        skeleton: of the animal, with a tube as its surface.
        width: (P,) half widths over the average animal's of that length, at `places`.
        height: (P,) half heights likewise.
        places: (P,) along the body, shares of its length, ascending.
    """
    average = Surface.of(skeleton)
    wide, high = (
        np.exp(np.interp(average.stations, places, np.log(factor))) for factor in (width, height)
    )
    shape = average.body
    assert isinstance(shape, BodyShape)
    return replace(
        average,
        body=replace(
            shape, half_width=shape.half_width * wide, half_height=shape.half_height * high
        ),
    )
