"""How thick a skeleton is drawn in replays, so that no animal vanishes behind its own joints.

A fish has twenty joints on 30 mm, a mouse five on 65.
"""

from __future__ import annotations

import numpy as np

from liex_lab.body.skeleton import Skeleton

_MOST_MM = 3.0
_OF_BONE = 0.3
_MOST_PT = 3.5
_LEAST_PT = 1.5


def dot_mm(skeleton: Skeleton) -> float:
    """Radius of a joint in space, mm: three tenths of the usual bone, at most 3.

    Args:
        skeleton: the animal's skeleton, at home size.
    """
    bones = np.linalg.norm(skeleton.offsets[1:], axis=1)
    return float(min(_MOST_MM, _OF_BONE * np.median(bones)))


def dot_pt(skeleton: Skeleton) -> float:
    """Radius of a joint over a picture, in points of the screen: 3.5, and 1.5 at least.

    Args:
        skeleton: the animal's skeleton, at home size.
    """
    return max(_LEAST_PT, _MOST_PT * float(np.sqrt(dot_mm(skeleton) / _MOST_MM)))
