"""The model file: what goes in comes out, equal models are equal bytes, and anything else is
refused in a sentence.
"""

import io
import json
import pickle
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from liex_lab.catalog import MODELS
from liex_lab.errors import ModelError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.model import N_CLUES, SCHEMA, ErrorCalibration, Model
from liex_lab.estimation.refine import N_OTHERS
from liex_lab.estimation.scoring import clue_samples
from liex_lab.estimation.training import calibrate
from liex_lab.forests.forest import Forest
from liex_lab.mlp import Network
from tests.estimation.toy import SCENE, tiny, toy_mice, train, unseen


@pytest.fixture(scope="module")
def model() -> Model:
    """A toy model whose file is small."""
    calibration = ErrorCalibration(
        0.25, 0.75, 0.125, (0.5, 1.75), (0.5, 1.0, 1.5, 0.75, 2.0), 4.5, 1111.0
    )
    small = train(toy_mice(120, 3), tiny("default")).model
    return replace(small, calibration=calibration, card={"animal": "mouse", "seed": 20})


@pytest.fixture(scope="module")
def content(model: Model) -> bytes:
    return model.to_bytes()


def forests_of(model: Model) -> list[Forest]:
    expectation = [model.expectation] if model.expectation else []
    return [forest for rounds in model.cascade.forests for forest in rounds] + [
        model.metric,
        *expectation,
    ]


def nothing(_: dict[str, Any]) -> None:
    """No change of a head."""


def repacked(
    content: bytes,
    change: Callable[[dict[str, Any]], Any] = nothing,
    without: str = "-",
    arrays: Mapping[str, np.ndarray] = {},
) -> bytes:
    """A model file whose head was changed, that lacks the entries that begin with `without`, and in
    which arrays were replaced or put in.
    """
    with np.load(io.BytesIO(content)) as archive:
        kept = {name: archive[name] for name in archive.files if not name.startswith(without)}
    if "head" in kept:
        head = json.loads(kept["head"].tobytes())
        change(head)
        kept["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    return packed(np.savez, **{**kept, **arrays})


def packed(save: Callable[..., None], *values: Any, **named: Any) -> bytes:
    """What a function of numpy writes."""
    out = io.BytesIO()
    save(out, *values, **named)
    return out.getvalue()


def array_of(content: bytes, name: str) -> np.ndarray:
    with np.load(io.BytesIO(content)) as archive:
        return archive[name]


def refusal(folder: Path, content: bytes, name: str = "model.npz") -> str:
    """The one sentence with which a model file is refused; it names the file."""
    (folder / name).write_bytes(content)
    with pytest.raises(ModelError) as error:
        Model.load(folder / name)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert str(folder / name) in sentence
    return sentence


def test_corrections_of_a_model_come_out_of_its_file_as_they_went_in(tmp_path, model):
    j = model.skeleton.n_joints
    parts = {
        "settler": np.random.default_rng(3).normal(size=(2 * j + N_OTHERS, j + 4)),
        "facing": Network.plain([(np.ones((6, 1), np.float32), np.zeros(1, np.float32))]),
        "corrector": replace(model.metric, leaves=np.repeat(model.metric.leaves, 3 * j, axis=1)),
    }
    made = replace(model, **parts)
    path = tmp_path / "toy.npz"
    for whole in (made, *(replace(made, **{name: None}) for name in parts)):
        path.write_bytes(whole.to_bytes())
        loaded = Model.load(path)
        assert loaded.to_bytes() == whole.to_bytes()
        assert (loaded.card, loaded.calibration) == (model.card, model.calibration)
        assert [getattr(loaded, name) is None for name in parts] == [
            getattr(whole, name) is None for name in parts
        ]
        np.testing.assert_array_equal(loaded.settler, whole.settler)


@pytest.mark.parametrize("variant", ["default", "paper"])
def test_equal_training_gives_equal_bytes_from_which_the_model_is_read_back(tmp_path, variant):
    method = replace(tiny(variant), rounds=1)
    toy, made = toy_mice(80, 3), []
    threads = numba.get_num_threads()
    for n in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(n)
        try:
            result = train(toy, method, seed=5)
            model = calibrate(result.model, result.data, np.random.default_rng(1))
            made.append(model.to_bytes())
        finally:
            numba.set_num_threads(threads)
    assert made[0] == made[1]
    assert train(toy, method, seed=6).model.to_bytes() != made[0]
    (tmp_path / "toy.npz").write_bytes(made[0])
    loaded = Model.load(tmp_path / "toy.npz")
    for before, after in zip(forests_of(model), forests_of(loaded), strict=True):
        for name in ("nodes", "roots", "leaves"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert (loaded.method, loaded.calibration) == (model.method, model.calibration)
    assert (loaded.to_bytes(), loaded.digest()) == (made[0], model.digest())


def test_equal_models_are_equal_bytes_whatever_the_day(model, content, monkeypatch):
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2033, 5, 18, 3, 33, 20, 2, 138, 0))
    assert model.to_bytes() == content


def test_a_file_that_would_run_code_is_refused_unread(tmp_path):
    ran = tmp_path / "ran"

    class Bomb:
        def __reduce__(self):
            return Path.touch, (ran,)

    refusal(tmp_path, packed(np.savez, head=np.array([Bomb()], object)))
    refusal(tmp_path, pickle.dumps(Bomb()))
    assert not ran.exists()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused(tmp_path, content, share):
    assert "not a complete model file" in refusal(tmp_path, content[: int(share * len(content))])


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_file_is_refused(tmp_path, content, seed):
    rng = np.random.default_rng(seed)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [entry for entry in archive.infolist() if entry.compress_size > 64]
    entry = entries[rng.integers(len(entries))]
    damaged = np.frombuffer(content, np.uint8).copy()
    first = entry.header_offset + 30 + len(entry.filename)
    damaged[first + rng.integers(12, entry.compress_size, 4)] ^= np.uint8(rng.integers(1, 256))
    assert "not a complete model file" in refusal(tmp_path, damaged.tobytes())


def test_a_file_that_lacks_a_part_is_refused(tmp_path, content):
    refusal(tmp_path, repacked(content, without="003_leaves"))
    refusal(tmp_path, repacked(content, without="head"))
    assert "has 8 forests" in refusal(tmp_path, repacked(content, without="008"))


@pytest.mark.parametrize(
    "change",
    [
        *(lambda head, section=name: head.pop(section) for name in ("method", "skeleton", "card")),
        lambda head: head.pop("calibration"),
        lambda head: head["method"].pop("reach_mm"),
        lambda head: head["method"].update(spin=3),
        lambda head: head["calibration"].update(spin=3),
    ],
)
def test_a_file_whose_head_lacks_a_section_or_has_other_fields_is_refused(
    tmp_path, content, change
):
    refusal(tmp_path, repacked(content, change))


def root_at(place: int, root: int) -> Callable[[np.ndarray], np.ndarray]:
    """Roots of which one was changed."""
    return lambda roots: np.where(np.arange(len(roots)) == place % len(roots), root, roots)


def middle_kind(kind: int) -> Callable[[np.ndarray], np.ndarray]:
    """Kinds of tests of which one was changed."""
    return lambda kinds: np.where(np.arange(len(kinds)) == len(kinds) // 2, kind, kinds)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        *(
            (f"{which}_roots", root_at(place, root), "root|complete trees")
            for which in ("000", "007")
            for place in (0, -1)
            for root in (2**30, -1, -(2**31), 7)
        ),
        *(
            (f"{which}_kind", middle_kind(kind), "a test")
            for which in ("000", "003", "007")
            for kind in (3, 4 * 60, 1 + 4 * 60, 2 + 4 * 60)
        ),
        ("000_tests", lambda tests: np.where(tests == tests.max(), -128, tests), "an offset"),
        ("000_leaves", lambda leaves: leaves * np.float16(np.nan), "its leaves"),
        ("000_leaves", lambda leaves: leaves[:-1], "its leaves"),
        *(
            (f"000_{part}", change, "model")
            for part in ("tests", "threshold", "kind", "is_leaf", "roots", "leaves")
            for change in (
                lambda values: values[..., :-1],
                lambda values: values.astype(np.float64),
                lambda values: values[None],
                lambda values: values[..., :0],
            )
        ),
        ("settler", lambda _: np.zeros((3, 3)), "ridge"),
    ],
)
def test_arrays_that_are_no_forest_of_this_model_are_refused(tmp_path, content, name, change, says):
    values = array_of(content, name) if name != "settler" else np.zeros(1)
    changed = change(values)
    if says != "model":
        changed = changed.astype(values.dtype)
    assert re.search(says, refusal(tmp_path, repacked(content, arrays={name: changed})))


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("method", "rounds", -1),
        ("method", "rounds", 2.0),
        ("method", "n_candidates", 0),
        ("method", "n_candidates", 10**9),
        ("method", "top_k", -3),
        ("method", "survivors", -1),
        ("method", "reach_mm", float("nan")),
        ("method", "reach_mm", "far"),
        ("method", "top_tau", 1e300),
        ("calibration", "slope", float("inf")),
        ("calibration", "joint_share", [1.0]),
        ("calibration", "quantiles", []),
    ],
)
def test_numbers_of_the_method_that_make_no_sense_are_refused(
    tmp_path, content, section, key, value
):
    def change(head):
        head[section][key] = value

    assert refusal(tmp_path, repacked(content, change))


def test_layers_of_another_network_are_refused(tmp_path, content):
    for weights in (np.zeros((5, 3)), np.zeros((5, 4)), np.zeros(4)):
        layer = {
            "facing_0_bias": np.zeros(4, np.float16),
            "facing_0_weights": weights.astype(np.float16),
        }
        assert "layers of a network" in refusal(tmp_path, repacked(content, arrays=layer))


@pytest.mark.parametrize(
    "animal",
    [*(pytest.param(name, marks=pytest.mark.nightly) for name in ("mouse", "hand")), "fish"],
)
def test_bundled_models_pass_and_keep_their_bytes(animal):
    path = MODELS / f"{animal}.npz"
    assert Model.load(path).to_bytes() == path.read_bytes()


def test_the_expectation_forest_sees_as_many_clues_as_are_checked(model):
    estimator = PoseEstimator(model)
    crops = SCENE.extract(unseen().depths[:2], 1.0)
    found = estimator.candidates(crops, SCENE.crop_cameras(crops), 1.0)
    chosen = replace(estimator.pick(found, 1.0), fit=np.zeros((2, 3)))
    samples = clue_samples(chosen, model.skeleton, found.images, 1.0)
    assert samples.scalars.shape[1] == N_CLUES + 3


def test_a_file_of_a_newer_version_asks_for_an_upgrade(tmp_path, content):
    def newer(head: dict[str, Any]) -> None:
        head["schema"] = SCHEMA + 1
        head["method"] = {"something": "else"}

    assert "upgrade liex_lab" in refusal(tmp_path, repacked(content, newer))


FOREIGN = {
    "npz": packed(np.savez, weights=np.arange(5.0)),
    "npy": packed(np.save, np.arange(5.0)),
    "zip": b"PK\x05\x06" + bytes(18),
    "head": packed(np.savez, head=np.frombuffer(b"[1, 2]", np.uint8)),
    "text": b"a mouse of 65 mm\n",
    "png": b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_refused(tmp_path, kind):
    refusal(tmp_path, FOREIGN[kind])


def test_a_folder_and_a_missing_file_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "absent.npz"):
        with pytest.raises(ModelError, match=r"model") as error:
            Model.load(path)
        assert str(path) in str(error.value)
