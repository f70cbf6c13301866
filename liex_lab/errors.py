"""Errors that a user can correct.

Each message is one sentence: what was expected, what was found, what to do.
"""

import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar


def printable(text: object) -> str:
    """A text that is safe for a terminal: no file name can move the cursor or hide text.

    Args:
        text: any object; its text may quote names of files and recordings.

    Returns:
        The text; control characters, bidirectional controls and surrogates are escaped. Line ends
            and tabs stay.
    """
    plain = str(text)
    if plain.isascii() and plain.isprintable():
        return plain
    return "".join(
        c if c in "\n\t\u200d" or unicodedata.category(c) not in _UNSEEN else ascii(c)[1:-1]
        for c in plain
    )


_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def how_to_install(extra: str) -> str:
    """The command that installs optional packages in a clone of liex_lab.

    Args:
        extra: its name among the optional dependencies of pyproject.toml.
    """
    return (
        f"install it with `pip install '.[{extra}]'` in the folder that holds liex_lab's "
        "pyproject.toml"
    )


class LiexError(Exception):
    """Base of every error that the user can correct.

    The command line prints only its message, without a traceback.

    Attributes:
        exit_code: of the command line.
    """

    exit_code: ClassVar[int] = 1

    def __str__(self) -> str:
        """The message on one line, with quoted names made safe for a terminal."""
        return printable(" ".join(super().__str__().splitlines()))


class RecordingError(LiexError):
    """Raised for a recording that cannot be opened or read."""


class UnknownCameraError(RecordingError):
    """Raised for depth images without information on their camera."""


class UnknownTimesError(RecordingError):
    """Raised for depth images without timestamps."""


class SeveralKindsError(RecordingError):
    """Raised for a folder with depth images of several kinds.

    Attributes:
        pattern: matches the images of one of the kinds, such as `*.tif`.
    """

    def __init__(self, message: str, pattern: str) -> None:
        super().__init__(message)
        self.pattern = pattern


class PlanError(LiexError):
    """Raised for a plan, or a value in it, that cannot be used."""


class ModelError(LiexError):
    """Raised for a model that is missing, damaged or made for another animal."""


class SessionError(LiexError):
    """Raised for a session folder that is missing, unfinished or not made by liex_lab."""


class PlaceError(LiexError):
    """Raised for a path that must not be written to, such as one behind a symbolic link."""


class StudyError(LiexError):
    """Raised for a study file, or something in it, that cannot be used."""


class EstimationError(LiexError):
    """Raised for a recording in which the animal cannot be measured."""


class MisfitError(EstimationError):
    """Raised for a recording of something other than the plan's animal.

    Its exit code is also that of a run whose session needs review.
    """

    exit_code = 4


class MissingPackageError(LiexError):
    """Raised if a required optional package is not installed."""


@contextmanager
def needing(extra: str, what: str) -> Iterator[None]:
    """Raise MissingPackageError for an import in the block whose package is not installed.

    Args:
        extra: the optional dependencies with the package, see `how_to_install`.
        what: what needs it, as the subject of a sentence.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"{what} needs {error.name}; {how_to_install(extra)}") from None


def did_you_mean(word: object, known: Iterable[str], form: str = "did you mean '{}'? ") -> str:
    """A hint at the known name that is nearest to a mistyped one; "" if none is near.

    Args:
        word: what was typed.
        known: the names.
        form: the hint, with {} for the name.
    """
    import difflib

    near = difflib.get_close_matches(str(word), list(known), 1)
    return form.format(near[0]) if near else ""


def one_line(error: BaseException) -> str:
    """First line of another package's error message, for use in a sentence.

    At most 200 characters; the type's name replaces an empty message. Of several errors of pydantic
    it is the first one: where, and what was expected.
    """
    text = str(error)
    if isinstance(error, ValueError) and hasattr(error, "errors"):
        first = error.errors(include_url=False, include_input=False)[0]
        what = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
        where = ".".join(str(part) for part in first["loc"])
        text = ascii(f"{where} {what}".strip())[1:-1]
    return text.strip().partition("\n")[0][:200] or type(error).__name__


@contextmanager
def expecting(
    kind: type[LiexError], sentence: str, *caught: type[Exception], advice: str = ""
) -> Iterator[None]:
    """Report errors of other packages in the block as one sentence: what was expected, what came.

    Args:
        kind: class of the error.
        sentence: what was expected, such as "FILE should be a TOML file".
        *caught: classes of the errors.
        advice: what to do.
    """
    try:
        yield
    except caught as error:
        ending = f"; {advice}" if advice else ""
        raise kind(f"{sentence}, but: {one_line(error)}{ending}") from None


def refuse(kind: type[Exception], *checks: tuple[object, str]) -> None:
    """Raise the first error of a list of checks.

    Args:
        kind: class of the error.
        checks: whether there is an error, and its sentence.
    """
    for is_wrong, sentence in checks:
        if is_wrong:
            raise kind(sentence)
