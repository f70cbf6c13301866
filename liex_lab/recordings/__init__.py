"""Depth recordings of every format, opened by one function: `open_recording`.

A recording is lazy, in order of time, and in millimetres along the optical axis, whatever its file
format.
"""

from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.open import open_recording
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import Gap

__all__ = ["DepthFrame", "Gap", "Recording", "open_recording"]
