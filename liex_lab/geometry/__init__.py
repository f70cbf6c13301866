"""Lie groups of rigid motion: SO(3), SE(3), geodesics and Brownian motion (Lie-X section 3).

Twists are (omega, nu): radians, then millimetres.
"""

from liex_lab.geometry.se3 import SE3, brownian_ends, brownian_steps

__all__ = ["SE3", "brownian_ends", "brownian_steps"]
