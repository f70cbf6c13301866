"""Change one value in a TOML file that a person wrote, and keep every comment and line of theirs.

The result is read again. It must state what the file stated, with that one value changed; otherwise
the file is refused.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from liex_lab.errors import PlanError
from liex_lab.plan.plan import toml_value

Path = tuple[str | int, ...]  # keys, and the numbers of tables in lists


def with_value(text: str, path: Path, value: Any, origin: str = "the file") -> str:
    """A TOML text with one value changed, added or removed.

    Args:
        text: the text.
        path: keys, and numbers from 0 for tables in lists, as in ("sessions", 2, "set", "arena",
            "region").
        value: a table, list, text, number or bool; None removes it.
        origin: names the file in errors.

    Raises:
        PlanError: the text is not TOML, or it is written in a way that cannot be changed in place.
    """
    try:
        wanted = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise PlanError(f"{origin} should be a TOML file, but: {error}; correct it") from None
    try:
        _set(wanted, path, value)
    except (IndexError, TypeError, AttributeError):
        table = ".".join(map(str, path[:-1]))
        raise PlanError(f"there is no table {table} to change") from None
    _drop_empty(wanted, path[:-1])
    for made in _candidates(text, path, value):
        with suppress(tomllib.TOMLDecodeError, RecursionError):
            found = tomllib.loads(made)
            _drop_empty(found, path[:-1])
            if found == wanted:
                return made
    dotted = ".".join(str(part) for part in path if isinstance(part, str))
    what = f"removing {dotted}" if value is None else f"{dotted} = {toml_value(value)}"
    raise PlanError(
        f"{origin} is written in a way that cannot be changed without losing something of it; "
        f"change it by hand: {what}"
    )


def _set(table: Any, path: Path, value: Any) -> None:
    """Set a value of a nested table in place; None removes it."""
    for part in path[:-1]:
        if isinstance(part, str) and part not in table:
            if value is None:
                return
            table[part] = {}
        table = table[part]
    if value is None:
        table.pop(path[-1], None)
        return
    # tomlkit counts the comments above the next header to the table before them
    body = getattr(getattr(table, "value", None), "body", [])
    trailing: list[Any] = []
    while path[-1] not in table and body and body[-1][0] is None:
        trailing.insert(0, body.pop())
    table[path[-1]] = value
    body.extend(trailing)


def _drop_empty(table: Any, path: Path) -> None:
    """Remove the empty tables on a path: they state nothing."""
    if path and (isinstance(path[0], int) or path[0] in table):
        _drop_empty(table[path[0]], path[1:])
        if table[path[0]] == {} and isinstance(table, dict):
            del table[path[0]]


def _candidates(text: str, path: Path, value: Any) -> Iterator[str]:
    """Texts that may state the value, the one with the smallest change first."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    told = None if value is None else toml_value(value)
    if told is not None:  # `Plan.to_toml` writes `# key =` for what is not set
        header, key = (re.escape(name) for name in (".".join(map(str, path[:-1])), str(path[-1])))
        unset = rf"(^\[{header}\](?:(?!^\[).)*?^)# {key} =[ \t]*(?=\r?$)"
        stated = f"{path[-1]} = {told}"
        yield re.sub(unset, lambda found: found[1] + stated, text, count=1, flags=re.M | re.S)
    for clear in (False, True):  # a table in several lines is removed first
        with suppress(TOMLKitError, LookupError, TypeError, ValueError, AttributeError):
            document = tomlkit.parse(text)
            if clear:
                _set(document, path, None)
            _set(document, path, told and tomlkit.value(told))
            made = tomlkit.dumps(document)
            yield re.sub(r"(?<!\r)\n", "\r\n", made) if "\r\n" in text else made
