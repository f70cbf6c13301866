"""What is measured of one animal for the tables and figures of the paper."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Results:
    """All that is known of one animal: rows by variant, missing: why a row is not there,
    sensitivity by variant, illustration of the default.
    """

    animal: str
    joints: list[str]
    splits: list[str]
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    sensitivity: dict[str, Any] = field(default_factory=dict)
    illustration: dict[str, Any] = field(default_factory=dict)
