"""The model file: what goes in comes out, equal models are equal bytes, and anything else is
refused in a sentence.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from liex_lab.errors import ModelError
from liex_lab.estimation.calibration import calibrate
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.model import SCHEMA, Calibration, Model
from liex_lab.forests.forest import Forest
from tests.estimation.toy import SCENE, tiny, toy_mice, train, trained, training_set, unseen

VARIANTS = ["default", "paper"]


@pytest.fixture(scope="module")
def model() -> Model:
    calibration = Calibration(
        0.25, 0.75, 0.125, (0.5, 1.75), (0.5, 1.0, 1.5, 0.75, 2.0), 4.5, 1111.0
    )
    return replace(
        trained("default").model, calibration=calibration, card={"animal": "mouse", "seed": 20}
    )


@pytest.fixture(scope="module")
def content(model: Model) -> bytes:
    return model.to_bytes()


def forests_of(model: Model) -> list[Forest]:
    expectation = [model.expectation] if model.expectation else []
    return [forest for rounds in model.cascade.forests for forest in rounds] + [
        model.metric,
        *expectation,
    ]


def repacked(content: bytes, change: Callable[[dict[str, Any]], None], without: str = "") -> bytes:
    """A model file whose head was changed, and that lacks the entries that begin with `without`."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "head.npy":
                head = json.loads(np.lib.format.read_array(io.BytesIO(data)).tobytes())
                change(head)
                packed = io.BytesIO()
                np.lib.format.write_array(
                    packed, np.frombuffer(json.dumps(head).encode(), np.uint8)
                )
                data = packed.getvalue()
            if not (without and name.startswith(without)):
                new.writestr(name, data)
    return out.getvalue()


def refusal(folder: Path, content: bytes, name: str = "model.npz") -> str:
    """The one sentence with which a model file is refused; it names the file."""
    (folder / name).write_bytes(content)
    with pytest.raises(ModelError) as error:
        Model.load(folder / name)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert str(folder / name) in sentence
    return sentence


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_model_comes_out_of_its_file_as_it_went_in(tmp_path, variant):
    model = trained(variant).model
    (tmp_path / "toy.npz").write_bytes(model.to_bytes())
    loaded = Model.load(tmp_path / "toy.npz")
    for before, after in zip(forests_of(model), forests_of(loaded), strict=True):
        np.testing.assert_array_equal(after.nodes, before.nodes)
        np.testing.assert_array_equal(after.roots, before.roots)
        np.testing.assert_array_equal(after.leaves, before.leaves)
    assert loaded.method == model.method
    assert loaded.calibration == model.calibration
    assert loaded.to_bytes() == model.to_bytes()
    assert loaded.digest() == model.digest()


def test_facts_about_the_model_and_its_expectation_come_out_as_well(tmp_path, model):
    whole = calibrate(model, training_set(unseen(), model.method), np.random.default_rng(0))
    (tmp_path / "toy.npz").write_bytes(whole.to_bytes())
    loaded = Model.load(tmp_path / "toy.npz")
    assert loaded.card == {"animal": "mouse", "seed": 20}
    assert loaded.calibration == whole.calibration
    assert loaded.calibration.area_mm2 == 1111.0
    assert loaded.skeleton.names == model.skeleton.names
    assert loaded.expectation is not None
    assert whole.expectation is not None
    np.testing.assert_array_equal(loaded.expectation.leaves, whole.expectation.leaves)


def test_an_estimator_measures_the_same_with_the_model_read_back(tmp_path, model, content):
    (tmp_path / "toy.npz").write_bytes(content)
    before, after = (
        estimator.estimate(unseen().depths[:8], SCENE, 1.0).chosen
        for estimator in (PoseEstimator(model), PoseEstimator.load(tmp_path / "toy.npz"))
    )
    np.testing.assert_array_equal(
        after.pose.joints(model.skeleton), before.pose.joints(model.skeleton)
    )
    np.testing.assert_array_equal(after.error_mm, before.error_mm)


@pytest.mark.parametrize("variant", VARIANTS)
def test_equal_training_gives_equal_bytes_with_one_thread_and_with_two(variant):
    method = replace(tiny(variant), rounds=1)
    toy, made = toy_mice(80, 3), []
    threads = numba.get_num_threads()
    for n in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(n)
        try:
            result = train(toy, method, seed=5)
            made.append(calibrate(result.model, result.data, np.random.default_rng(1)).to_bytes())
        finally:
            numba.set_num_threads(threads)
    assert made[0] == made[1]
    assert train(toy, method, seed=6).model.to_bytes() != made[0]


def test_equal_models_are_equal_bytes_whatever_the_day(model, content, monkeypatch):
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2033, 5, 18, 3, 33, 20, 2, 138, 0))
    assert model.to_bytes() == content


def test_there_is_no_pickle_inside(content):
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        assert all(archive[name].dtype != object for name in archive.files)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert all(archive.read(name).startswith(b"\x93NUMPY") for name in archive.namelist())


def test_a_file_that_would_run_code_is_refused_unread(tmp_path):
    ran = tmp_path / "ran"

    class Bomb:
        def __reduce__(self):
            return Path.touch, (ran,)

    archive = io.BytesIO()
    np.savez(archive, head=np.array([Bomb()], object))
    refusal(tmp_path, archive.getvalue())
    refusal(tmp_path, pickle.dumps(Bomb()))
    assert not ran.exists()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused(tmp_path, content, share):
    assert "not a whole model file" in refusal(tmp_path, content[: int(share * len(content))])


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_file_is_refused(tmp_path, content, seed):
    rng = np.random.default_rng(seed)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [entry for entry in archive.infolist() if entry.compress_size > 64]
    entry = entries[rng.integers(len(entries))]
    damaged = np.frombuffer(content, np.uint8).copy()
    first = entry.header_offset + 30 + len(entry.filename)
    damaged[first + rng.integers(12, entry.compress_size, 4)] ^= np.uint8(rng.integers(1, 256))
    assert "not a whole model file" in refusal(tmp_path, damaged.tobytes())


def test_a_file_that_lacks_a_part_is_refused(tmp_path, content):
    refusal(tmp_path, repacked(content, lambda head: None, without="003_leaves"))
    refusal(tmp_path, repacked(content, lambda head: None, without="head"))
    assert "holds 8 forests" in refusal(
        tmp_path, repacked(content, lambda head: None, without="008")
    )


@pytest.mark.parametrize("section", ["method", "skeleton", "calibration", "card"])
def test_a_file_whose_head_lacks_a_section_is_refused(tmp_path, content, section):
    refusal(tmp_path, repacked(content, lambda head: head.pop(section)))


def test_a_file_of_a_method_with_other_fields_is_refused(tmp_path, content):
    refusal(tmp_path, repacked(content, lambda head: head["method"].pop("reach_mm")))
    refusal(tmp_path, repacked(content, lambda head: head["method"].update(spin=3)))
    refusal(tmp_path, repacked(content, lambda head: head["calibration"].update(spin=3)))


def test_a_file_of_a_newer_version_asks_for_an_upgrade(tmp_path, content):
    def newer(head: dict[str, Any]) -> None:
        head["schema"] = SCHEMA + 1
        head["method"] = {"something": "else"}

    assert "upgrade liex_lab" in refusal(tmp_path, repacked(content, newer))


def foreign_npz() -> bytes:
    out = io.BytesIO()
    np.savez(out, weights=np.arange(5.0))
    return out.getvalue()


def foreign_npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.arange(5.0))
    return out.getvalue()


def foreign_zip() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("head", "not an array")
    return out.getvalue()


def foreign_head() -> bytes:
    out = io.BytesIO()
    np.savez(out, head=np.frombuffer(b"[1, 2]", np.uint8))
    return out.getvalue()


FOREIGN = {
    "npz": foreign_npz(),
    "npy": foreign_npy(),
    "zip": foreign_zip(),
    "head": foreign_head(),
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
