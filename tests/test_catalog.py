"""What comes with the package is found, and a model whose bytes are not what its card says is
refused.
"""

import hashlib
import json
from pathlib import Path

import pytest

from liex_lab import catalog
from liex_lab.errors import LiexError, ModelError


@pytest.fixture
def models(tmp_path: Path) -> Path:
    content = b"the model's bytes"
    (tmp_path / "mouse.npz").write_bytes(content)
    card = {"sha256": hashlib.sha256(content).hexdigest(), "animal": "mouse"}
    (tmp_path / "mouse.json").write_text(json.dumps(card))
    return tmp_path


def test_a_model_is_found_by_name_and_by_path(models: Path) -> None:
    assert catalog.find_model("mouse", models) == models / "mouse.npz"
    assert catalog.find_model(models / "mouse.npz", Path("elsewhere")) == models / "mouse.npz"
    assert catalog.bundled_models(models)["mouse"]["animal"] == "mouse"


def test_a_model_of_ones_own_needs_no_card(models: Path) -> None:
    own = models / "own.npz"
    own.write_bytes(b"mine")
    assert catalog.find_model(own, Path("elsewhere")) == own


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("mouse.npz", b"other bytes", "damaged or was changed"),
        *(("mouse.json", card, "model card") for card in (b"{", b"[]", b"{}", b'{"sha256": 3}')),
        ("mouse.json", None, "needs its card"),
    ],
)
def test_a_damaged_model_or_card_is_refused_in_a_sentence(
    models: Path, file: str, content: bytes | None, message: str
) -> None:
    if content is None:
        (models / file).unlink()
    else:
        (models / file).write_bytes(content)
    with pytest.raises(ModelError, match=message):
        catalog.find_model("mouse", models)


@pytest.mark.parametrize(
    ("name", "hint"), [("mose", "did you mean 'mouse'"), ("x.npz", "bundled are: mouse")]
)
def test_a_wrong_name_says_which_there_are(models: Path, name: str, hint: str) -> None:
    with pytest.raises(ModelError, match=hint):
        catalog.find_model(name, models)


def test_every_bundled_model_is_what_its_card_says() -> None:
    for name in catalog.bundled_models():
        assert catalog.find_model(name).is_file()


def test_the_data_sets_are_found_and_a_wrong_sample_lists_them() -> None:
    assert (catalog.datasets_folder() / "README.md").is_file()
    with pytest.raises(LiexError, match="no bundled sample 'nothing'; there are:"):
        catalog.find_sample("nothing")
