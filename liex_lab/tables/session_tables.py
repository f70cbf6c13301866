"""What can be read from a measured session: the face that `sessions.Session` shows to the rooms
below it.
"""

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
        """The outline of the floor."""

    @property
    def zones(self) -> Sequence[Zone]:
        """The zones that were drawn, in the arena's frame."""

    @property
    def frames(self) -> pd.DataFrame:
        """One row per frame of the recording."""

    @property
    def gaps(self) -> pd.DataFrame:
        """One row per stretch without frames or without a pose."""

    @property
    def bouts(self) -> pd.DataFrame:
        """The ethogram."""

    @property
    def summary(self) -> pd.DataFrame:
        """One row per animal."""

    def table(self, name: str, columns: list[str] | None = None) -> pd.DataFrame:
        """Any table by its name, or some of its columns."""
