"""Action models on disk: skops files, which contain numbers and words but no code; bundled models.

Format 2; format 1 had no peaks and is still read.
"""

import json
import re
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import UNLABELLED
from liex_lab.actions.timeline import SemiMarkovModel, TimelineModel
from liex_lab.catalog import MODELS, find_file, sha256
from liex_lab.errors import ModelError, refuse
from liex_lab.mlp import Network, check_layers
from liex_lab.runtime.durable import replacing

_MOST_BYTES = 1 << 28
_ADDRESS = re.compile(r'("__id__": |"file": ")(\d+)')


def write_plain(document: Any, path: str | Path) -> None:
    """Write a skops file; equal content gives equal bytes.

    skops names its objects by memory addresses, and dates them; here names are numbers from 1 in
    their order in the file, and the date is always 1980-01-01.

    Args:
        document: dicts, lists, words, numbers and numpy arrays.
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
            # the earliest date of a zip entry
            packed.writestr(
                zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED
            )


def read_plain(path: str | Path) -> Any:
    """The content of a skops file of plain data, as given to `write_plain`.

    Raises:
        ValueError: the file contains anything but plain data, is nested more than 20 deep, or
            unpacks to more than 256 MB.
    """
    with zipfile.ZipFile(path) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > _MOST_BYTES:
            raise ValueError(f"it unpacks to more than {_MOST_BYTES >> 20} MB")
        return _value(json.loads(packed.read("schema.json")), packed, 0)


def _value(node: Any, packed: zipfile.ZipFile, depth: int) -> Any:
    """The value of a schema's node; raises ValueError if it is not plain data."""
    if depth > 20:
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


SUFFIX = ".skops"
_FORMAT = 2
_WITHOUT_PEAKS = 1
_LONGEST_S = 3600.0  # of an action; each tick of its shortest duration is a state
_FASTEST_HZ = 1000.0


def save_action_model(model: TimelineModel, path: str | Path) -> Path:
    """Write a model; equal models give files of equal content.

    The file is written under another name and renamed, so it is never incomplete.

    Args:
        model: a trained recogniser.
        path: the file; its suffix becomes .skops.

    Returns:
        The path written.
    """
    target = Path(path).with_suffix(SUFFIX)
    target.parent.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {
        "format": _FORMAT,
        "skeleton": model.skeleton,
        "clock_hz": model.clock_hz,
        "words": list(model.words),
        "share": model.share,
        "sharpness": model.sharpness,
        "speeds": model.speeds,
        "peaks": model.peaks,
        "definitions": dict(model.definitions),
        "card": dict(model.card),
        "chain": {
            name: getattr(model.chain, name) for name in SemiMarkovModel.__dataclass_fields__
        },
        "networks": [
            {
                "centre": n.centre,
                "scale": n.scale,
                "layers": [[w.astype(np.float32), b] for w, b in n.layers],
            }
            for n in model.networks
        ],
    }
    with replacing(target) as unfinished:
        write_plain(document, unfinished)
    return target


def load_action_model(name: str | Path, folder: Path = MODELS) -> TimelineModel:
    """A bundled model by its animal ('mouse'), or one from a file.

    Args:
        name: the animal, or a path.
        folder: of the bundled models.

    Returns:
        The recogniser, with the file's sha256 on its card.

    Raises:
        ModelError: there is no such model, or the file cannot be used.
    """
    own = f"a {SUFFIX} file made by `liex train actions`"
    path = find_file(name, folder, SUFFIX, "action model", own)
    try:
        document = read_plain(path)
        if document["format"] not in (_FORMAT, _WITHOUT_PEAKS):
            raise ModelError(
                f"the action model {path} has format {document['format']}, this liex_lab reads "
                f"{_WITHOUT_PEAKS} and {_FORMAT}"
            )
        peaks = (
            np.zeros(len(document["words"]))
            if document["format"] == _WITHOUT_PEAKS
            else document["peaks"]
        )
        chain = SemiMarkovModel(
            *(np.asarray(document["chain"][name]) for name in SemiMarkovModel.__dataclass_fields__)
        )
        networks = tuple(
            Network(n["centre"], n["scale"], tuple((w, b) for w, b in n["layers"]))
            for n in document["networks"]
        )
        model = TimelineModel(
            document["skeleton"],
            float(document["clock_hz"]),
            tuple(document["words"]),
            document["share"],
            networks,
            chain,
            float(document["sharpness"]),
            document["speeds"],
            peaks,
            document["definitions"],
            {**document["card"], "sha256": sha256(path)},
        )
        check_timeline(model)
        return model
    except ModelError:
        raise
    except Exception as error:  # a foreign file can fail anywhere in the reader
        raise ModelError(
            f"{path} should be an action model made by `liex train actions`, but: "
            f"{type(error).__name__}: {error}"
        ) from None


def check_timeline(model: TimelineModel) -> None:
    """Check that all parts of a model from a file agree with its words.

    Raises:
        ValueError: the mismatch, as a part of a sentence.
    """
    k = len(model.words)
    chain = model.chain
    refuse(
        ValueError,
        (
            k < 2 or len(set(model.words)) != k or UNLABELLED not in model.words,
            "its words are not two or more, each named once, one for what has no name",
        ),
        (
            not all(isinstance(word, str) for word in (*model.words, model.skeleton)),
            "its words are not all words",
        ),
        (not model.networks, "it holds no network"),
        (
            not 0.0 < model.clock_hz <= _FASTEST_HZ or not np.isfinite(model.sharpness),
            f"its clock should tick up to {_FASTEST_HZ:.0f} times a second",
        ),
    )
    for name, values, shape in (
        ("share", model.share, (k,)),
        ("speeds", model.speeds, (k, 2)),
        ("peaks", model.peaks, (k,)),
        ("shortest_s", chain.shortest_s, (k,)),
        ("mean_s", chain.mean_s, (k,)),
        ("follow", chain.follow, (k, k)),
    ):
        if np.shape(values) != shape or values.dtype.kind != "f" or np.isnan(values).any():
            raise ValueError(f"its {name} should be numbers of the shape {shape}")
    durations = np.concatenate([chain.shortest_s, chain.mean_s])
    if not ((durations >= 0) & (durations <= _LONGEST_S)).all():
        raise ValueError(f"its actions should last between 0 and {_LONGEST_S:.0f} s")
    for network in model.networks:
        check_layers(network, k)


def bundled_action_models(folder: Path = MODELS) -> list[str]:
    """The animals with a bundled action model in `folder`, sorted."""
    return sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))
