"""Exports of a session to other programs' formats: NWB, BORIS, DeepLabCut, movement, SLEAP, CSV.

One writer per format, each tested with the other program's own reader.
"""

from liex_lab.exchange.export import TARGETS, export

__all__ = ["TARGETS", "export"]
