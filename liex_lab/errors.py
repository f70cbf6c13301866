"""Errors that a user can put right.

Each message is one sentence: what was expected, what came, what to do.
"""

from __future__ import annotations

import unicodedata
from typing import ClassVar


def printable(text: object) -> str:
    """A text as a terminal may show it: no name of a file moves the cursor or hides what follows.

    Args:
        text: anything; what it says of itself may quote names of files and recordings.

    Returns:
        The text; control characters, those that turn the direction of writing, and halves of
        characters are written as escapes. Line ends and tabs stay.
    """
    said = str(text)
    if said.isascii() and said.isprintable():
        return said
    return "".join(
        c if c in "\n\t\u200d" or unicodedata.category(c) not in _UNSEEN else ascii(c)[1:-1]
        for c in said
    )


_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def how_to_install(extra: str) -> str:
    """What to type for packages that only some need: a line that works in a clone of liex_lab.

    Args:
        extra: its name among the optional dependencies of pyproject.toml.
    """
    return (
        f"install it with `pip install '.[{extra}]'` in the folder that holds liex_lab's "
        "pyproject.toml"
    )


class LiexError(Exception):
    """Base of every error that the user can put right.

    The command line prints its message alone, without a traceback.

    Attributes:
        exit_code: that the command line ends with.
    """

    exit_code: ClassVar[int] = 1

    def __str__(self) -> str:
        """The message on one line, whatever it quotes of the user's own."""
        return printable(" ".join(super().__str__().splitlines()))


class RecordingError(LiexError):
    """Raised for a recording that cannot be opened or read."""


class UnknownCameraError(RecordingError):
    """Raised for pictures that do not say what camera took them."""


class UnknownTimesError(RecordingError):
    """Raised for pictures that do not say when they were taken."""


class SeveralKindsError(RecordingError):
    """Raised for a folder with pictures of several kinds.

    Attributes:
        pattern: names the pictures of one of the kinds, as in `*.tif`.
    """

    def __init__(self, message: str, pattern: str) -> None:
        super().__init__(message)
        self.pattern = pattern


class PlanError(LiexError):
    """Raised for a plan, or a value in it, that cannot be used."""


class ModelError(LiexError):
    """Raised for a model that is missing, damaged or made for another animal."""


class SessionError(LiexError):
    """Raised for a session folder that is missing, unfinished or not of liex_lab."""


class PlaceError(LiexError):
    """Raised for a place that nothing may be written to, such as one behind a symbolic link."""


class StudyError(LiexError):
    """Raised for a study file, or something in it, that cannot be used."""


class EstimationError(LiexError):
    """Raised for a recording in which the animal cannot be measured."""


class MisfitError(EstimationError):
    """Raised for a recording that shows something else than the plan's animal.

    Its exit code is also that of a run whose session someone has to look at.
    """

    exit_code = 4


class MissingPackageError(LiexError):
    """Raised where an optional package is needed for what was asked and is not installed."""


def one_line(error: BaseException) -> str:
    """First line of what an error of another package says, as a part of a sentence.

    Args:
        error: the error; its type's name stands in for an empty message.

    Returns:
        At most 200 characters.
    """
    return str(error).strip().partition("\n")[0][:200] or type(error).__name__
