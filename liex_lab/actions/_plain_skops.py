"""The skops format (zip of schema.json and .npy files) for plain data, byte-reproducible.

Holds nothing but tables, lists, words, numbers and arrays; read without scikit-learn, and written
so that equal contents are equal bytes. Importing skops asks scikit-learn and Dask for everything
they have, which takes as long as a short recording.
"""

from __future__ import annotations

import json
import re
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

_DEEPEST = 20
_MOST_BYTES = 1 << 28
_THE_DAY = (1980, 1, 1, 0, 0, 0)  # the first that a zip knows
_ADDRESS = re.compile(r'("__id__": |"file": ")(\d+)')


def write_plain(document: Any, path: str | Path) -> None:
    """Write a skops file of equal bytes for equal content.

    skops names what it holds by addresses in memory, and dates it; here names are numbers from 1 on
    in their order in the file, and the date is one day, 1980-01-01.

    Args:
        document: tables, lists, words, numbers and numpy arrays.
        path: the file to write.
    """
    from skops import io

    with zipfile.ZipFile(BytesIO(io.dumps(document))) as packed:
        schema = packed.read("schema.json").decode()
        arrays = {name: packed.read(name) for name in packed.namelist() if name.endswith(".npy")}
    number = {
        found: k + 1
        for k, found in enumerate(dict.fromkeys(at for _, at in _ADDRESS.findall(schema)))
    }
    schema = _ADDRESS.sub(lambda found: f"{found[1]}{number[found[2]]}", schema)
    contents = {f"{number[name.removesuffix('.npy')]}.npy": arrays[name] for name in arrays}
    names = sorted(contents, key=lambda name: int(name.removesuffix(".npy")))
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in [
            *((name, contents[name]) for name in names),
            ("schema.json", schema.encode()),
        ]:
            packed.writestr(zipfile.ZipInfo(name, _THE_DAY), content, zipfile.ZIP_DEFLATED)


def read_plain(path: str | Path) -> Any:
    """The content of a skops file of plain data.

    Args:
        path: the file.

    Returns:
        What `write_plain` was given.

    Raises:
        ValueError: the file holds anything but plain data, is nested more than 20 deep, or unpacks
            to more than 256 MB.
    """
    with zipfile.ZipFile(path) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > _MOST_BYTES:
            raise ValueError(f"it unpacks to more than {_MOST_BYTES >> 20} MB")
        return _value(json.loads(packed.read("schema.json")), packed, 0)


def _value(node: Any, packed: zipfile.ZipFile, depth: int) -> Any:
    """What a node of the schema stands for; raises ValueError where that is not plain data."""
    if depth > _DEEPEST:
        raise ValueError("its tables are nested too deeply")
    kind = node["__loader__"]
    content = node.get("content")
    if kind == "DictNode":
        return {str(key): _value(inner, packed, depth + 1) for key, inner in content.items()}
    if kind == "ListNode":
        return [_value(inner, packed, depth + 1) for inner in content]
    if kind == "JsonNode":
        return json.loads(content)
    if kind == "NdArrayNode" and node.get("type") == "numpy":
        with packed.open(node["file"]) as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    raise ValueError(
        f"it holds a {kind}, and an action model is made of tables, lists, words and arrays alone"
    )
