"""Model files: skeleton, method, forests, metric and calibration as one .npz without pickle.

The file is a ZIP archive (LZMA) of .npy arrays: `head` is JSON as bytes; each forest is stored as
six arrays `NNN_tests`, `_threshold`, `_kind`, `_is_leaf`, `_roots` and `_leaves` (float16), the
child pointers being implied by the order of growth; `settler` is the ridge correction and
`facing_*` the head-tail classifier. Loading never runs code, and equal models give equal bytes.
"""

import hashlib
import io
import json
import lzma
import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import ModelError, expecting
from liex_lab.estimation._feature_kernels import N_SCALARS
from liex_lab.estimation._residual_kernels import N_FIT
from liex_lab.estimation.cascade import Cascade
from liex_lab.estimation.method import Method, Number
from liex_lab.estimation.refine import N_OTHERS
from liex_lab.forests._kernels import number_nodes
from liex_lab.forests.forest import Forest, check_forest, check_roots
from liex_lab.mlp import Network, check_layers
from liex_lab.runtime.memory import check_npz

Part = TypeVar("Part")
N_CLUES = 22  # of `scoring.clue_samples`, the residuals apart
SCHEMA = 3  # of a model with a head-tail classifier; 2 of one without
# after the regressors, if present
_FORESTS = ("metric", "expectation", "pruner", "corrector", "proposals")
_DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    EOFError,
    NotImplementedError,
    RecursionError,
    MemoryError,
    zipfile.BadZipFile,
    lzma.LZMAError,
)


@dataclass(frozen=True)
class ErrorCalibration:
    """Conversion of the metric's score to mm, learned on images that no tree was grown on.

        error = offset + slope * score + spread_slope * spread        (mm at home size)

    Attributes:
        offset: mm at home size.
        slope: mm of error per mm of score.
        spread_slope: mm of error per mm of spread of the averaged candidates.
        quantiles: (2,) the 5 % and 95 % quantiles of the ratio of true to predicted error.
        joint_share: (J,) each joint's error over the mean; empty: 1 for every joint.
        doubtful_mm: a predicted error above this, mm at home size, is flagged.
        area_mm2: usual area of a home-sized animal from above, mm^2.
        logarithmic: the expectation forest predicts LOG_UNIT times the logarithm of the error.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    offset: Number = 0.0
    slope: Number = 1.0
    spread_slope: Number = 0.0
    quantiles: tuple[Number, Number] = (0.5, 2.0)
    joint_share: tuple[Number, ...] = ()
    doubtful_mm: Number = 10.0
    area_mm2: Number = 1300.0
    logarithmic: bool = False


@dataclass(frozen=True)
class Model:
    """Everything that a pose estimator needs.

    Attributes:
        cascade: skeleton, method and regressors.
        metric: the learned metric R_m, which predicts a candidate's mean joint error.
        expectation: forest that predicts the expected error of a chosen pose; None: the
            calibration's line is used.
        skeleton_table: the skeleton's TOML as a table.
        calibration: conversion of the metric's score to mm.
        card: provenance of the model.
        pruner: the small metric on the base joint only; None: nothing is pruned.
        corrector: forest that corrects the joints of the chosen pose, see `scoring`.
        settler: (F, J + 4) table of the ridge correction, if the method has one.
        facing: network of the head-tail classifier, if the method has one.
    """

    cascade: Cascade
    metric: Forest
    expectation: Forest | None
    skeleton_table: dict[str, Any]
    calibration: ErrorCalibration = field(default_factory=ErrorCalibration)
    card: dict[str, Any] = field(default_factory=dict)
    pruner: Forest | None = None
    corrector: Forest | None = None
    settler: NDArray[np.float64] | None = None
    facing: Network | None = None

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.cascade.skeleton

    @property
    def method(self) -> Method:
        """The variant of the method."""
        return self.cascade.method

    @property
    def proposals(self) -> Forest | None:
        """The forest that proposes initial poses; None if they are drawn."""
        return self.cascade.proposals

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the learned metric, which identifies the model among those of the
        same animal.
        """
        return hashlib.sha256(self.metric.nodes.tobytes()).hexdigest()[:16]

    def to_bytes(self) -> bytes:
        """The content of the model file; equal models give equal bytes."""
        extra = [name for name in _FORESTS if getattr(self, name) is not None]
        head = {
            "schema": 2 if self.facing is None else SCHEMA,
            "method": self.method.to_dict(),
            "skeleton": self.skeleton_table,
            "calibration": vars(self.calibration),
            "card": self.card,
            "forests": extra,
        }
        arrays: dict[str, NDArray[Any]] = {
            "head": np.frombuffer(json.dumps(head, sort_keys=True).encode(), np.uint8)
        }
        forests = [forest for rounds in self.cascade.forests for forest in rounds]
        forests += [getattr(self, name) for name in extra]
        for k, forest in enumerate(forests):
            arrays.update({f"{k:03d}_{name}": values for name, values in _split(forest).items()})
        if self.settler is not None:
            arrays["settler"] = self.settler
        for k, layer in enumerate(self.facing.layers if self.facing else ()):
            for name, values in zip(_LAYER_PARTS, layer, strict=True):
                arrays[f"{_LAYER}{k}_{name}"] = values.astype(np.float16)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_LZMA) as archive:
            for name, values in arrays.items():
                content = io.BytesIO()
                np.lib.format.write_array(content, values, allow_pickle=False)
                # a fixed date, so that equal models are equal bytes
                entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_LZMA
                archive.writestr(entry, content.getvalue())
        return packed.getvalue()

    @staticmethod
    def load(path: Path) -> "Model":
        """Read a model file.

        Args:
            path: path of an .npz that `to_bytes` made.

        Raises:
            ModelError: there is no such file, it is not a complete model file, or a newer program
                made it.
        """
        try:
            # opened here, for numpy leaves a damaged archive open
            check_npz(path, 1 << 30)  # unpacked, ten times the largest bundled one
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                head = json.loads(archive["head"].tobytes())
                if head.get("schema", 0) > SCHEMA:
                    raise ModelError(
                        f"{path} was made by a newer liex_lab (schema {head['schema']}); upgrade "
                        "liex_lab"
                    )
                names = sorted({name[:3] for name in archive.files if name[0].isdigit()})
                forests = [
                    _join({part: archive[f"{name}_{part}"] for part in _PARTS}) for name in names
                ]
                settler = archive["settler"] if "settler" in archive.files else None
                n_layers = sum(name.startswith(_LAYER) for name in archive.files) // 2
                layers = [
                    [archive[f"{_LAYER}{k}_{name}"].astype(np.float32) for name in _LAYER_PARTS]
                    for k in range(n_layers)
                ]
                facing = Network.plain(layers) if f"{_LAYER}0_bias" in archive.files else None
            method = _checked(Method, head["method"])
            calibration = _checked(ErrorCalibration, head["calibration"])
            table, card = head["skeleton"], head["card"]
        except FileNotFoundError:
            raise ModelError(
                f"there is no model file {path}; name a bundled model or the path of an .npz"
            ) from None
        except _DAMAGE as error:
            raise ModelError(
                f"{path} is not a complete model file ({error}); train it again or copy it again"
            ) from None
        skeleton = Skeleton.from_table(table, str(path))
        rounds = [method.rounds_of(joint) for joint in skeleton.solved]
        n_regressors = sum(rounds)
        # schema 1 did not state it
        extra = head.get("forests", _FORESTS[: len(forests) - n_regressors])
        if len(forests) != n_regressors + len(extra) or "metric" not in extra:
            raise ModelError(
                f"{path} has {len(forests)} forests, not {n_regressors} and a metric; train it "
                "again"
            )
        named = dict(zip(extra, forests[n_regressors:], strict=True))
        stops = np.cumsum(rounds).tolist()
        each = [forests[stop - n : stop] for n, stop in zip(rounds, stops, strict=True)]
        model = Model(
            Cascade(skeleton, method, each, named.get("proposals")),
            named["metric"],
            named.get("expectation"),
            table,
            calibration,
            card,
            named.get("pruner"),
            named.get("corrector"),
            settler,
            facing,
        )
        with expecting(
            ModelError,
            f"{path} should hold a usable model",
            *_DAMAGE,
            advice="train it again or copy it again",
        ):
            check_model(model)
        return model

    def digest(self) -> str:
        """SHA-256 of the model file, as hexadecimal digits."""
        return hashlib.sha256(self.to_bytes()).hexdigest()


def check_model(model: Model) -> None:
    """Check every number of a model from a file that is used as an index or a size.

    Args:
        model: the model as read.

    Raises:
        ValueError: the error, as a part of a sentence.
    """
    skeleton = model.skeleton
    method = model.method
    j = skeleton.n_joints
    n_fit = N_FIT if method.explains else 0
    n_refined = N_FIT if method.refine_steps else 0
    expected: list[tuple[str, Forest | None, tuple[int, int, int]]] = [
        (f"of {skeleton.names[joint]}", forest, (1, N_SCALARS, model.cascade.n_values(joint)))
        for joint, rounds in zip(skeleton.solved, model.cascade.forests, strict=True)
        for forest in rounds
    ]
    if len({forest.n_trees for _, forest, _ in expected if forest is not None}) > 1:
        raise ValueError("its forests of the joints have different numbers of trees")
    expected += [
        ("metric", model.metric, (j, N_SCALARS + n_fit, 1)),
        ("expectation", model.expectation, (1, N_CLUES + n_refined, 1)),
        ("pruner", model.pruner, (1, N_SCALARS, 1)),
        ("corrector", model.corrector, (j, N_SCALARS + 1, 3 * j)),
        ("proposals", model.proposals, (1, N_SCALARS + 1, 12)),  # a rotation matrix and a position
    ]
    for name, forest, sizes in expected:
        if forest is not None:
            try:
                check_forest(forest, *sizes)
            except ValueError as error:
                raise ValueError(f"forest {name}: {error}") from None
    if len(model.calibration.joint_share) not in (0, j):
        raise ValueError(f"its calibration is not of {j} joints")
    settler = model.settler
    if settler is not None and not (
        skeleton.is_chain
        and settler.dtype == np.float64
        and settler.shape == (2 * j + N_OTHERS, j + 4)
        and np.isfinite(settler).all()
    ):
        raise ValueError("its ridge correction is not of this skeleton")
    if model.facing is not None:
        check_layers(model.facing, 1)
    if method.explains or method.refine_steps:
        balls = model.cascade.balls.joints
        if balls.size and (balls.min() < 0 or balls.max() >= j):
            raise ValueError(f"a sphere of its body is on none of the {j} joints")


def _checked(kind: type[Part], values: Any) -> Part:
    """A part of the head of a model file; ValueError names its first field that is wrong."""
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where} of its {kind.__name__}: {first['msg']}") from None


_LAYER = "facing_"
_LAYER_PARTS = ("weights", "bias")


_KINDS = {
    "tests": np.int8,
    "threshold": np.int16,
    "kind": np.uint8,
    "is_leaf": np.uint8,
    "roots": np.int32,
    "leaves": np.float16,
}
_PARTS = tuple(_KINDS)
_FARTHEST = 127  # largest offset
_TABLES = ("tests", "leaves")


def _split(forest: Forest) -> dict[str, NDArray[Any]]:
    """A forest as arrays that compress well.

    The child pointers are omitted, as they follow from which nodes are leaves.
    """
    words = forest.nodes
    inner = words[:, 2] >= 0
    tests = np.ascontiguousarray(words[inner, :2]).view(np.int8).reshape(-1, 8)
    return {
        "tests": np.ascontiguousarray(tests[:, :6].T),
        "threshold": np.ascontiguousarray(tests[:, 6:]).view(np.int16).ravel(),
        "kind": words[inner, 3].astype(np.uint8),
        "is_leaf": np.packbits(~inner),
        "roots": forest.roots,
        "leaves": np.ascontiguousarray(forest.leaves.astype(np.float16).T),
    }


def _join(parts: dict[str, NDArray[Any]]) -> Forest:
    """The inverse of `_split`.

    Growth numbers nodes and leaves in one order: a tree's children are appended as a pair when
    their parent splits, the left side of the stack first, so traversing the trees in that order
    restores every pointer.
    """
    for name, kind in _KINDS.items():
        if parts[name].dtype != kind or parts[name].ndim != (2 if name in _TABLES else 1):
            raise ValueError(f"{name} of a forest is not a list of {np.dtype(kind)}")
    if parts["tests"].min(initial=0) < -_FARTHEST:
        raise ValueError(f"an offset of a test is below -{_FARTHEST}")
    n_inner = len(parts["threshold"])
    n_leaves = parts["leaves"].shape[1]
    n_nodes = n_inner + n_leaves
    is_leaf = np.unpackbits(parts["is_leaf"], count=n_nodes).astype(bool)
    if len(is_leaf) != n_nodes or int(is_leaf.sum()) != n_leaves:
        raise ValueError(f"a forest does not have as many leaves as values, {n_leaves}")
    check_roots(parts["roots"], is_leaf)
    nodes = np.zeros((n_nodes, 4), np.int32)
    words = np.empty((n_inner, 8), np.int8)
    words[:, :6] = parts["tests"].T
    words[:, 6:] = parts["threshold"].view(np.int8).reshape(-1, 2)
    nodes[~is_leaf, :2] = words.view(np.int32)
    nodes[~is_leaf, 3] = parts["kind"]
    number_nodes(is_leaf, np.append(parts["roots"], n_nodes).astype(np.int64), nodes)
    return Forest(nodes, parts["roots"], np.ascontiguousarray(parts["leaves"].T.astype(np.float32)))
