"""The articulated body: kinematic tree, pose, forward and inverse kinematics, surface, renderer."""

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton

__all__ = ["Pose", "Skeleton"]
