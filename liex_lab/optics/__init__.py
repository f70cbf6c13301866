"""From a pixel to a ray and back: pinhole cameras, lens distortion, a water surface."""

from liex_lab.optics.camera import Camera

__all__ = ["Camera"]
