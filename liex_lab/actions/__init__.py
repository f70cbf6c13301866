"""From a track to an ethogram: segments of the curve get names."""

from liex_lab.actions.ethogram import Bout, Ethogram

__all__ = ["Bout", "Ethogram"]
