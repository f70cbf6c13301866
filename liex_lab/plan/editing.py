"""One value put into a TOML file that a person wrote, with every comment and line of theirs kept.

The file is read as statements: headers `[a.b]`, `[[a]]` and `key = value`, each with the place it
has in the text and the path it states. The value of a key that is there is replaced in place; a new
key goes to the end of the table that it belongs to. What comes out is read again and has to be what
was there with that one value changed, or the file is not touched at all.
"""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from liex_lab.errors import PlanError
from liex_lab.plan.plan import toml_value

Path = tuple[str | int, ...]  # keys, and the numbers of tables in lists
_STRINGS = ('"""', "'''", '"', "'")
_BARE = re.compile(r"[A-Za-z0-9_-]+")


@dataclass(frozen=True)
class _Statement:
    """A header or a key with its value: what it states, and where.

    Attributes:
        path: of what it states.
        start: where it begins, at its first letter.
        value: where its value begins; `stop` for a header.
        stop: after its last letter.
        table: path of the table that it stands in.
    """

    path: Path
    start: int
    value: int
    stop: int
    table: Path

    @property
    def is_header(self) -> bool:
        return self.value == self.stop


def with_value(text: str, path: Path, value: Any, origin: str = "the file") -> str:
    """A TOML text with one value changed, added or taken out; all else stays as it is written.

    Args:
        text: the text.
        path: of the value: keys, and numbers from 0 for tables in lists, as in ("sessions", 2,
            "set", "arena", "region").
        value: what it is to be: a table, list, text, number or bool; None takes it out.
        origin: names the file in errors.

    Returns:
        The text.

    Raises:
        PlanError: the text is no TOML, or it is written in a way that cannot be changed in place.
    """
    try:
        wanted = _changed(tomllib.loads(text), path, value)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise PlanError(f"{origin} should be a TOML file, but: {error}; correct it") from None
    told = None if value is None else toml_value(value)
    with suppress(IndexError, ValueError, AttributeError):  # a text that we read otherwise
        for made in _candidates(text, path, told, wanted):
            with suppress(tomllib.TOMLDecodeError, RecursionError):
                if _without_empty(tomllib.loads(made), path) == _without_empty(wanted, path):
                    return made
    dotted = ".".join(str(part) for part in path if isinstance(part, str))
    what = f"{dotted} = {told}" if told else f"taking out {dotted}"
    raise PlanError(
        f"{origin} is written in a way that cannot be changed without losing something of it; "
        f"change it by hand: {what}"
    )


def _changed(table: dict[str, Any], path: Path, value: Any) -> dict[str, Any]:
    """The content with the value changed: what has to come out."""
    out = copy.deepcopy(table)
    inner: Any = out
    for part in path[:-1]:
        if isinstance(inner, dict):
            if value is None and part not in inner:
                return out
            inner = inner.setdefault(part, {})
        elif isinstance(inner, list) and isinstance(part, int) and part < len(inner):
            inner = inner[part]
        else:
            raise PlanError(f"there is no table {'.'.join(map(str, path[:-1]))} to change")
    if not isinstance(inner, dict):
        raise PlanError(f"there is no table {'.'.join(map(str, path[:-1]))} to change")
    if value is None:
        inner.pop(path[-1], None)
    else:
        inner[path[-1]] = value
    return out


def _without_empty(table: dict[str, Any], path: Path) -> dict[str, Any]:
    """The content without the empty tables on the way to a value: they state nothing."""
    out = copy.deepcopy(table)
    way: list[Any] = [out]
    for part in path[:-1]:
        if isinstance(way[-1], dict) and part not in way[-1]:
            break
        way.append(way[-1][part])
    for k in range(len(way) - 1, 0, -1):
        if way[k] == {} and isinstance(way[k - 1], dict):
            del way[k - 1][path[k - 1]]
    return out


def _candidates(text: str, path: Path, told: str | None, wanted: dict[str, Any]) -> Iterator[str]:
    """Texts in which the value may be as it is wanted, the one that changes least first."""
    statements = list(_statements(text))
    keys = [one for one in statements if not one.is_header]
    same = next((one for one in keys if one.path == path), None)
    if same is not None and told is not None:
        yield text[: same.value] + told + text[same.stop :]
        return
    around = next((one for one in keys if path[: len(one.path)] == one.path), None)
    if around is not None and around is not same:  # a table written in one line holds it
        inner: Any = wanted
        for part in around.path:
            inner = inner[part]
        yield text[: around.value] + toml_value(inner) + text[around.stop :]
        return
    bare = text
    for one in reversed(statements):  # what states it in several lines, its header too
        if one.path[: len(path)] == path:
            bare = _without(bare, one)
    if told is None:
        yield bare
        return
    yield from _inserted(bare, path, told)


def _inserted(text: str, path: Path, told: str) -> Iterator[str]:
    """Texts with the value put into the nearest table, or into a table of its own."""
    line = "\r\n" if "\r\n" in text else "\n"
    statements = list(_statements(text))
    homes = [one for one in statements if one.is_header and path[: len(one.path)] == one.path]
    homes.sort(key=lambda one: -len(one.path))
    for home in homes[:1]:
        within = [one for one in statements if one.table == home.path and not one.is_header]
        key = _dotted(path[len(home.path) :])
        unset = _unset_line(text, home, statements, key)
        if unset is not None:
            yield text[: unset[0]] + f"{key} = {told}" + text[unset[1] :]
        after = _line_end(text, within[-1].stop if within else home.stop)
        yield _with_line(text, after, f"{key} = {told}", line)
    header = f"[{_dotted(path[:-1])}]"
    own = f"{header}{line}{_dotted(path[-1:])} = {told}"
    last = max((one.stop for one in statements if path[:2] == one.path[:2]), default=len(text))
    at = _line_end(text, last) if any(isinstance(part, int) for part in path) else len(text)
    yield _with_line(text, at, (line if text[:at].strip() else "") + own, line)


def _with_line(text: str, at: int, new: str, line: str) -> str:
    begun = line if at and not text[:at].endswith("\n") else ""
    return text[:at] + begun + new + line + text[at:]


def _unset_line(
    text: str, home: _Statement, statements: Sequence[_Statement], key: str
) -> tuple[int, int] | None:
    """Where a line `# key =` of the table says that this is not set, as `Plan.to_toml` writes."""
    after = [one.start for one in statements if one.is_header and one.start > home.start]
    block = text[home.stop : min(after, default=len(text))]
    found = re.search(rf"^# {re.escape(key)} =[ \t]*$", block, re.MULTILINE)
    return None if found is None else (home.stop + found.start(), home.stop + found.end())


def _without(text: str, one: _Statement) -> str:
    """The text without a statement and what follows on its line."""
    start = text.rfind("\n", 0, one.start) + 1
    return text[:start] + text[_line_end(text, one.stop) :]


def _line_end(text: str, at: int) -> int:
    """Where the line of a place ends, after its line break."""
    found = text.find("\n", at)
    return len(text) if found < 0 else found + 1


def _dotted(path: Sequence[str | int]) -> str:
    keys = [part for part in path if isinstance(part, str)]
    return ".".join(key if _BARE.fullmatch(key) else toml_value(key) for key in keys)


def _statements(text: str) -> Iterator[_Statement]:
    """The statements of a TOML text that can be read, in order."""
    table: Path = ()
    counted: dict[Path, int] = {}
    at = 0
    while (at := _skip(text, at)) < len(text):
        start = at
        if text[at] == "[":
            many = text.startswith("[[", at)
            keys, at = _keys(text, at + 1 + many)
            at = text.index("]", at) + 1 + many
            path = _numbered(keys, counted)
            if many:
                counted[path] = counted.get(path, -1) + 1
                for below in [one for one in counted if one[: len(path)] == path and one != path]:
                    del counted[below]
                path = (*path, counted[path])
            table = path
            yield _Statement(path, start, at, at, table)
            continue
        keys, at = _keys(text, at)
        value = _blank(text, text.index("=", at) + 1)
        at = _value_end(text, value)
        yield _Statement((*table, *keys), start, value, at, table)


def _numbered(keys: Sequence[str], counted: dict[Path, int]) -> Path:
    """The path of a header, with the number of the last table of each list that it goes through."""
    path: Path = ()
    for k, key in enumerate(keys):
        path = (*path, key)
        if path in counted and k < len(keys) - 1:
            path = (*path, counted[path])
    return path


def _keys(text: str, at: int) -> tuple[list[str], int]:
    """The keys of a dotted key, and where it ends."""
    keys: list[str] = []
    while True:
        at = _blank(text, at)
        stop = _string_end(text, at) if text[at] in "\"'" else _BARE.match(text, at).end()  # type: ignore[union-attr]
        keys.append(next(iter(tomllib.loads(f"{text[at:stop]} = 0"))))
        at = _blank(text, stop)
        if text[at] != ".":
            return keys, at
        at += 1


def _value_end(text: str, at: int) -> int:
    """Where a value ends that begins here."""
    depth = 0
    while at < len(text):
        if text[at] in "\"'":
            at = _string_end(text, at)
        elif text[at] in "[{":
            depth += 1
            at += 1
        elif text[at] in "]}":
            depth -= 1
            at += 1
        elif text[at] == "#":
            if not depth:
                break
            at = _line_end(text, at)
        elif text[at] == "\n" and not depth:
            break
        else:
            at += 1
            continue
        if not depth:
            return at
    return len(text[:at].rstrip())


def _string_end(text: str, at: int) -> int:
    """Where a string ends that begins here."""
    quote = next(one for one in _STRINGS if text.startswith(one, at))
    at += len(quote)
    while not text.startswith(quote, at):
        at += 2 if text[at] == "\\" and quote[0] == '"' else 1
    at += len(quote)
    while len(quote) == 3 and text.startswith(quote[0], at):  # up to two more belong to the text
        at += 1
    return at


def _skip(text: str, at: int) -> int:
    """Past blanks, line breaks and comments."""
    while at < len(text) and text[at] in " \t\r\n#":
        at = _line_end(text, at) if text[at] == "#" else at + 1
    return at


def _blank(text: str, at: int) -> int:
    while at < len(text) and text[at] in " \t":
        at += 1
    return at
