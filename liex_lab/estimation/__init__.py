"""One depth frame in, a point on the pose manifold out (Lie-X Algorithms 1 and 2)."""
