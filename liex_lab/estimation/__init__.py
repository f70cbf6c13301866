"""Estimation of one point on the pose manifold per depth frame (Lie-X Algorithms 1 and 2)."""
