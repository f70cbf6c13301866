"""The articulated body: its skeleton, its pose, the joints of a pose, and the surface
around them.
"""

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton

__all__ = ["Pose", "Skeleton"]
