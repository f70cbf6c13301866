"""Where the labelled hands lie that test postures are fitted to.

Test pictures of a hand depend on them: with them postures are those of a person whom no training
picture was drawn after, without them they are drawn from the statistics that training postures come
from, too. There is one place for them, whatever folder a command runs in.
"""

from __future__ import annotations

import os
from pathlib import Path

from liex_lab.errors import LiexError
from liex_lab.recordings.formats.images.nyu import N_FIRST_PERSON, REFERENCE_FILE

VARIABLE = "LIEX_NYU"
FITTED = f"fitted to the labels of the NYU test frames from {N_FIRST_PERSON + 1} on"
DRAWN = "drawn from statistics of one person's hand"
_REPOSITORY = Path(__file__).resolve().parents[3]


def find_reference() -> Path | None:
    """The folder of labelled hands: what `LIEX_NYU` names, else that beside the repository.

    Returns:
        `LIEX_NYU`, or `../shared/data/hand_nyu` of the repository that this file is in; None where
        the variable is not set and no labels lie there.

    Raises:
        LiexError: `LIEX_NYU` names a folder without labels.
    """
    if stated := os.environ.get(VARIABLE):
        folder = Path(stated)
        if not (folder / REFERENCE_FILE).is_file():
            raise LiexError(
                f"{VARIABLE} should name a folder with {REFERENCE_FILE}, labels of NYU hands, but "
                f"{folder} holds none; name another one, or unset it"
            )
        return folder
    folder = _REPOSITORY.parent / "shared" / "data" / "hand_nyu"
    return folder if (folder / REFERENCE_FILE).is_file() else None
