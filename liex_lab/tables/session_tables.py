"""Protocol of a measured session's tables: what lower layers may read of `sessions.Session`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.arena.outline import Arena
    from liex_lab.arena.zones import Zone


class SessionTables(Protocol):
    """The tables of one session folder, and what its session.json states."""

    @property
    def metadata(self) -> dict[str, Any]:
        """The content of session.json."""

    @property
    def arena(self) -> Arena:
        """The outline of the floor, arena frame, mm."""

    @property
    def zones(self) -> Sequence[Zone]:
        """The zones that were drawn, arena frame, mm."""

    @property
    def frames(self) -> pd.DataFrame:
        """The table `frames`: one row per frame of the recording."""

    @property
    def gaps(self) -> pd.DataFrame:
        """The table `gaps`: one row per stretch without frames or a measured pose."""

    @property
    def bouts(self) -> pd.DataFrame:
        """The table `bouts`: the ethogram, one row per bout."""

    @property
    def summary(self) -> pd.DataFrame:
        """One row per animal."""

    def table(self, name: str, columns: list[str] | None = None) -> pd.DataFrame:
        """Any table by its name, or some of its columns.

        Args:
            name: of the table, such as 'poses'.
            columns: those that are wanted; None for all.

        Returns:
            The table in memory.
        """
