"""Bundled models with their model cards, and the data sets with their sample recordings.

A model is an .npz file of arrays; its card is the JSON file of the same name, which contains the
model's SHA-256. A model whose SHA-256 differs from its card is refused.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from liex_lab.errors import LiexError, ModelError, did_you_mean, expecting

_HERE = Path(__file__).resolve().parent
MODELS = _HERE / "models"
DEMO = "mouse_walk.mcap"  # the sample recording of `liex demo`


def datasets_folder() -> Path:
    """Path of the folder `datasets`: inside the installed package, or next to it in a clone.

    Both paths are tried, because importlib.resources does not find a folder without code in an
    editable install.

    Raises:
        LiexError: neither path exists.
    """
    for folder in (_HERE / "datasets", _HERE.parent / "datasets"):
        if folder.is_dir():
            return folder
    raise LiexError(
        f"the folder datasets should be in {_HERE} or beside it, but is in neither; install "
        "liex_lab again"
    )


def kept_results_folder() -> Path:
    """Path of the stored results of long trainings, one JSON for each animal."""
    return datasets_folder() / "kept_results"


def find_sample(name: str) -> Path:
    """Path of a bundled sample recording.

    Args:
        name: its file or folder in `datasets`.

    Raises:
        LiexError: there is no such sample; the message lists the samples.
    """
    folder = datasets_folder()
    if name and (folder / name).exists():
        return folder / name
    not_samples = {".toml", ".md"}
    kept = kept_results_folder()
    known = sorted(
        p.name
        for p in folder.iterdir()
        if p.suffix not in not_samples and p.name[0] != "." and p != kept
    )
    raise LiexError(f"there is no bundled sample '{name}'; there are: {', '.join(known) or 'none'}")


def bundled_models(folder: Path = MODELS) -> dict[str, dict[str, Any]]:
    """Cards of the bundled models in `folder` by model name, in alphabetical order.

    The hashes in the cards are not checked here.

    Raises:
        ModelError: a model lacks its card, or the card cannot be used.
    """
    return {
        path.stem: _read_card(path.with_suffix(".json")) for path in sorted(folder.glob("*.npz"))
    }


def find_file(name: str | Path, folder: Path, suffix: str, what: str, own: str) -> Path:
    """Path of a bundled file by its name, or of a user's own file.

    Args:
        name: a bundled name, such as 'mouse', or a path.
        folder: of the bundled files.
        suffix: of them.
        what: of what kind they are, for the message.
        own: how a user gets a file of one's own, for the message.

    Raises:
        ModelError: there is no such file; the message names the closest bundled one.
    """
    bundled = folder / f"{name}{suffix}"
    path = bundled if bundled.is_file() else Path(name)
    if not path.is_file():
        known = sorted(p.stem for p in folder.glob(f"*{suffix}"))
        near = did_you_mean(name, known, "did you mean '{}'")
        hint = near or f"bundled are: {', '.join(known) or 'none'}"
        raise ModelError(f"there is no {what} '{name}'; {hint}, or give the path of {own}")
    return path


def find_model(model: str | Path, folder: Path = MODELS) -> Path:
    """Path of a model file, after checking its SHA-256 against its card.

    The card is the .json of the same name next to the .npz. It is required for a bundled model and
    optional for a user's own.

    Args:
        model: a bundled name, such as 'mouse', or the path of an .npz.
        folder: of the bundled models.

    Raises:
        ModelError: there is no such model, or it is damaged or was changed.
    """
    path = find_file(model, folder, ".npz", "model", "an .npz made by `liex train`")
    card_path = path.with_suffix(".json")
    if path == folder / f"{model}.npz" or card_path.is_file():
        stated = _read_card(card_path)["sha256"]
        found = sha256(path)
        if stated != found:
            raise ModelError(
                f"the model {path} is damaged or was changed: its card states SHA-256 "
                f"{stated[:12]}..., the file has {found[:12]}...; install liex_lab again or make "
                "the model again with `liex train`"
            )
    return path


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_card(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ModelError(
            f"the model {path.stem} needs its card {path}, which is missing; install liex_lab again"
        )
    with expecting(
        ModelError,
        f"the model card {path} should be JSON",
        ValueError,
        advice="install liex_lab again",
    ):
        card = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(card, dict) or not isinstance(card.get("sha256"), str):
        raise ModelError(
            f"the model card {path} should state the model's sha256; make it again with `liex "
            "train`"
        )
    return card
