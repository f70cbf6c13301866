"""Optics of the depth camera: pinhole projection, lens distortion, refraction at water."""

from liex_lab.optics.camera import Camera

__all__ = ["Camera"]
