"""Key frames and path of each of the fish's actions, as Fig 19 of Lie-X shows them.

One cut-out test sequence of each action, acted and rendered as for `liex evaluate actions`; nothing
is measured. Surfacing and diving are seen from the side, all others from above.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...training.action_model import cut_sequences
from ...training.agent_tracks import Scenario, filmed_at

Array = NDArray[np.float64]

ANIMAL = "fish"
_KEY_FRAMES = 4
_FROM_THE_SIDE = ("surface", "dive")
_MOST_DOTS = 1_500  # of a body


def acted_key_frames() -> list[dict[str, Any]]:
    """Of the first test sequence of each action what the figure shows.

    Returns:
        For each action `word`; `side`, whether it is seen from the side; `path_mm` (n, 2) of the
        middle of the body; `bodies_mm`, of each key frame the points (m, 2) that the camera sees;
        `skeletons_mm` (k, J, 2); `edges`; and `seconds`, its length.
    """
    first: dict[str, Scenario] = {}
    for scenario in cut_sequences(ANIMAL, True):
        first.setdefault(scenario.word, scenario)
    return [_key_frames(scenario) for scenario in first.values()]


def _key_frames(scenario: Scenario) -> dict[str, Any]:
    side = scenario.word in _FROM_THE_SIDE
    film = filmed_at(scenario, _KEY_FRAMES)
    middle = film.joints.mean(axis=1)
    along = _direction(middle) if side else np.array([1.0, 0.0])
    origin = middle[0]

    def flat(points: Array) -> Array:
        """Points (..., 3) in the plane of the picture."""
        off = points - origin
        if side:
            return np.stack([off[..., :2] @ along, off[..., 2]], axis=-1)
        return off[..., :2]

    bodies = []
    for points in film.points:
        bodies.append(flat(points[:: max(1, -(-len(points) // _MOST_DOTS))]))
    return {
        "word": scenario.word,
        "side": side,
        "path_mm": flat(middle),
        "bodies_mm": bodies,
        "skeletons_mm": flat(film.joints[film.rows]),
        "edges": film.edges,
        "seconds": (len(middle) - 1) / scenario.rate_hz,
    }


def _direction(path: Array) -> Array:
    """The horizontal direction (2,) in which a path (n, 3) leads."""
    off = path[:, :2] - path[:, :2].mean(axis=0)
    _, _, axes = np.linalg.svd(off, full_matrices=False)
    way = axes[0]
    return np.asarray(way if (path[-1, :2] - path[0, :2]) @ way >= 0 else -way)
