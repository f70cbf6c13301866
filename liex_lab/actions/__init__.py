"""Action recognition: from a track to an ethogram, which names segments of the track.

Uncut recordings: network on window features and semi-Markov decoding (`timeline`). Cut-out
sequences: the random forest of Lie-X section 4.3 (`recogniser`).
"""

from liex_lab.actions.ethogram import Bout, Ethogram

__all__ = ["Bout", "Ethogram"]
