"""Documents with anything at all somewhere in them, for readers that promise an answer or one
sentence.
"""

from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from liex_lab.errors import LiexError

_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.integers(-3, 3),
    st.sampled_from(
        [
            "../x",
            "/etc/passwd",
            "mouse",
            "\0",
            "=1+1",
            "nan",
            "1e999",
            "\ud800",
            10**400,
            float("nan"),
        ]
    ),
)
ANYTHING = st.recursive(
    _LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)


def damage(document: Any, data: st.DataObject) -> None:
    """Put anything in the place of one value of nested dicts and lists, or take that away, or have
    it twice.
    """
    place = document
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        inner = place[key]
        if isinstance(inner, dict | list) and inner and data.draw(st.booleans()):
            place = inner
            continue
        act = data.draw(st.sampled_from(["put", "put", "put", "drop", "twice"]))
        if act == "put":
            place[key] = data.draw(ANYTHING)
        elif act == "drop":
            del place[key]
        elif isinstance(place, list):
            place.insert(key, inner)
        return


def check(read: Callable[[], object]) -> None:
    """An answer, or one sentence."""
    try:
        read()
    except LiexError as error:
        assert "\n" not in str(error), str(error)  # noqa: PT017
