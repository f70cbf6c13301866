"""Depth recordings of every format through one door: `open_recording`."""

from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.open import open_recording
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import Gap

__all__ = ["DepthFrame", "Gap", "Recording", "open_recording"]
