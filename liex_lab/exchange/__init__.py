"""What other programs read: one writer per format, each checked with the other program's own
reader.
"""

from liex_lab.exchange.export import TARGETS, export

__all__ = ["TARGETS", "export"]
