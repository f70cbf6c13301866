"""Marker-less 3D pose estimation of animals in depth recordings, after the Lie-X method.

A depth recording goes in; 3D skeletons, a replay and behaviour tables come out:

    session_folder = liex_lab.run_session("recording.mcap", plan=liex_lab.Plan.load("mouse"))
    poses = liex_lab.Session.open(session_folder).poses

Importing the package only prepares the cache folder of compiled kernels; each public name imports
its own module on first use.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from liex_lab.deprecated_paths import install_path_finder
from liex_lab.runtime.kernel_cache import keep_kernels

__version__ = "0.2.0"

install_path_finder()
# idle kernel threads sleep; OpenMP's default threads spin, on cores on which
# recordings are read and logs are written (libgomp reads this when it is loaded)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
_KERNELS_NOTICE = keep_kernels()  # a message for the command line, or an empty text

_HOMES = {
    "Camera": "liex_lab.optics.camera",
    "LiexError": "liex_lab.errors",
    "Plan": "liex_lab.plan",
    "PoseEstimator": "liex_lab.estimation.estimator",
    "SE3": "liex_lab.geometry",
    "Session": "liex_lab.sessions",
    "Skeleton": "liex_lab.body",
    "import_points": "liex_lab.api",
    "open_recording": "liex_lab.recordings",
    "run_session": "liex_lab.api",
}

__all__ = [
    "SE3",
    "Camera",
    "LiexError",
    "Plan",
    "PoseEstimator",
    "Session",
    "Skeleton",
    "__version__",
    "import_points",
    "open_recording",
    "run_session",
]

if TYPE_CHECKING:
    from liex_lab.api import import_points, run_session
    from liex_lab.body import Skeleton
    from liex_lab.errors import LiexError
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.geometry import SE3
    from liex_lab.optics.camera import Camera
    from liex_lab.plan import Plan
    from liex_lab.recordings import open_recording
    from liex_lab.sessions import Session


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'liex_lab' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
