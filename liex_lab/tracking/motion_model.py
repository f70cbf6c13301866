"""What the tracker believes of an animal: how it moves, how frames err, and what makes a chain of
hypotheses likely.

`tunings.toml` beside this module holds it for the bundled animals; `liex train tracking` finds it
again, on rendered sequences whose seeds are not those of any test.
"""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from liex_lab.tracking.association import ChainTuning
from liex_lab.tracking.smoother import Motion, Wandering

TUNINGS = Path(__file__).with_name("tunings.toml")
_USUAL = "mouse"  # what an animal is taken for that has none of its own


@dataclass(frozen=True)
class Tuning:
    """Of one animal."""

    chain: ChainTuning
    motion: Motion

    @staticmethod
    @cache
    def of(name: str) -> Tuning:
        """That of an animal by its skeleton's name."""
        known = tomllib.loads(TUNINGS.read_text(encoding="utf-8"))
        return Tuning.from_table(known.get(name, known[_USUAL]))

    @staticmethod
    def from_table(table: dict[str, Any]) -> Tuning:
        """From its table in TOML; three numbers of a coordinate are error, drive and fade."""
        motion = dict(table["motion"])
        for group in ("turn", "bend"):
            motion[group] = tuple(Wandering(*row) for row in motion[group])
        motion["size"] = Wandering(*motion["size"])
        for name in ("place_error", "place_drive", "stretch", "honest_root", "honest_bend"):
            motion[name] = tuple(motion[name])
        motion["honest"] = tuple((said, factor) for said, factor in motion["honest"])
        return Tuning(ChainTuning(**table["chain"]), Motion(**motion))

    def to_toml(self, name: str) -> str:
        """Its table in TOML."""
        lines = [
            f"[{name}.chain]",
            *(f"{key} = {_text(value)}" for key, value in asdict(self.chain).items()),
        ]
        lines += ["", f"[{name}.motion]"]
        for key, value in asdict(self.motion).items():
            rows = [list(row.values()) for row in value] if key in ("turn", "bend") else value
            rows = list(value.values()) if key == "size" else rows
            lines.append(f"{key} = {_text(rows)}")
        return "\n".join(lines) + "\n"


def tunings_with(name: str, tuning: Tuning) -> str:
    """The file `tunings.toml` with an animal's table replaced, or added to it."""
    text = TUNINGS.read_text(encoding="utf-8")
    head = text[: text.index("\n[")]
    known = {animal: Tuning.from_table(table) for animal, table in tomllib.loads(text).items()} | {
        name: tuning
    }
    return "\n".join(
        [head.rstrip("\n") + "\n", *(each.to_toml(animal) for animal, each in known.items())]
    )


def _text(value: Any) -> str:
    """A number, or lists of them, in TOML."""
    return (
        f"[{', '.join(map(_text, value))}]"
        if isinstance(value, list | tuple)
        else repr(float(f"{value:.4g}"))
    )
