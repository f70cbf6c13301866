"""The errors a user can put right. Each message is one sentence: what was expected, what came, what
to do.
"""

from __future__ import annotations


class LiexError(Exception):
    """Something the user can put right; the command line prints its message alone, without a
    traceback.
    """

    def __str__(self) -> str:
        """The message on one line, whatever it quotes of the user's own."""
        return " ".join(super().__str__().splitlines())


class RecordingError(LiexError):
    """A recording that cannot be opened or read."""


class PlanError(LiexError):
    """A plan, or a value in it, that cannot be used."""


class ModelError(LiexError):
    """A model that is missing, damaged or made for another animal."""


class SessionError(LiexError):
    """A session folder that is missing, unfinished or not ours."""


class StudyError(LiexError):
    """A study file, or something in it, that cannot be used."""


class EstimationError(LiexError):
    """A recording in which the animal cannot be measured."""


class MissingPackageError(LiexError):
    """An optional package that is needed for what was asked and not installed."""


def one_line(error: BaseException) -> str:
    """The first line of what an error of another package says, as a part of a sentence."""
    return str(error).strip().partition("\n")[0][:200] or type(error).__name__
