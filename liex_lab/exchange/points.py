"""Reader of 3D points from other programs: CSV, movement netCDF, DANNCE .mat, NumPy archives.

A table of names (`PointNames`, TOML) states what such a file does not: which of its points are our
joints, the unit, the upward axis, the height of the floor and the frame rate. The result is one
animal's points in mm, z up from the floor.
"""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, did_you_mean, expecting, how_to_install, one_line, refuse
from liex_lab.plan.sections import Positive, SettingsTable
from liex_lab.runtime.memory import check_npz
from liex_lab.runtime.text_files import read_text, read_toml, split_lines

Names = str | list[str]

_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_FEWEST = 10  # frames
_COORDINATE = re.compile(r"(.+)[_. ]([xyz])(?:_mm)?", re.IGNORECASE)
_COLUMNS = {  # what a column holds: its names in lower case and singular
    "point": ("keypoint", "bodypart", "node", "joint", "point", "marker"),
    "individual": ("individual", "animal", "track", "identity"),
    "time_s": ("time_s", "time", "timestamp"),
    "frames": ("frame", "fnum", "frame_index", "frame_number"),
    **{axis: (axis, f"{axis}_mm") for axis in "xyz"},
    "score": ("score", "likelihood", "confidence"),
}
_FLAT = "2D points, and heights are needed; triangulate them from several cameras"
_SYNONYMS = {"snout": "nose", "tailbase": "rump", "baseoftail": "rump", "tailroot": "rump"}


class PointNames(SettingsTable):
    """A table of names: what a file of points does not state. Every entry may be left out."""

    joints: dict[str, Names] = Field(
        {}, description="our joint = the file's point, or a list of points, which are averaged"
    )
    points: list[str] = Field([], description="names of the points, for a file without names")
    unit: Literal["mm", "cm", "m"] = Field("mm", description="unit of the coordinates")
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field("z", description="the upward axis")
    floor: float | None = Field(
        None,
        description="height of the floor along that axis, in that unit; not set: estimated",
    )
    fps: Positive | None = Field(None, description="frames per second, for a file without times")
    individual: str | None = Field(None, description="the animal to read, if there are several")
    words: dict[str, str] = Field(
        {}, description="our word = the person's word for it (liex evaluate actions)"
    )
    animals: dict[str, str] = Field(
        {}, description="name of a file = its animal (liex evaluate actions)"
    )

    @staticmethod
    def load(path: str | Path | None, **stated: Any) -> "PointNames":
        """The table of a TOML file.

        Args:
            path: the file; None for an empty table.
            **stated: entries that replace those of the file, unless they are None.

        Raises:
            LiexError: the file cannot be read, or an entry is unknown or invalid.
        """
        with expecting(
            LiexError,
            f"the table of names {path or ''} should be a TOML file with any of "
            f"{', '.join(PointNames.model_fields)}",
            OSError,
            ValueError,
            advice="correct it",
        ):
            return PointNames.model_validate(
                ({} if path is None else read_toml(Path(path)))
                | {name: value for name, value in stated.items() if value is not None}
            )

    def of_joints(self, joints: Sequence[str], points: Sequence[str]) -> dict[str, list[str]]:
        """The file's points of each joint, in the joints' order; joints without points are absent.

        Without [joints], a point belongs to the joint of its name; a snout is a nose, and a tail
        base a rump.

        Args:
            joints: our joints, from one end of the chain to the other.
            points: names of the file's points.

        Raises:
            LiexError: a joint or a point does not exist, or an end of the chain has no point.
        """
        plain = [re.sub(r"[\W_]", "", name).lower() for name in points]
        alike = {_SYNONYMS.get(k, k): point for k, point in zip(plain, points, strict=True)}
        stated = self.joints or {joint: alike[joint] for joint in joints if joint in alike}
        found = {
            joint: [names] if isinstance(names, str) else names
            for joint in joints
            if (names := stated.get(joint))
        }
        strange = [joint for joint in stated if joint not in joints]
        missing = [name for names in found.values() for name in names if name not in points]
        ends = [joint for joint in (joints[0], joints[-1]) if joint not in found]
        has = f"the file has {', '.join(points)}"
        refuse(
            LiexError,
            (
                strange,
                f"the table of names lists the joint {', '.join(strange)}, and this animal has "
                f"{', '.join(joints)}; correct [joints]",
            ),
            (
                missing,
                f"the file has no point {', '.join(missing)}; "
                f"{did_you_mean([*missing, ''][0], points)}{has}; correct [joints] in the table "
                "of names",
            ),
            (
                ends,
                f"both ends of the body need a point, and none is known of {' and '.join(ends)}; "
                f'{has}; write a table of names with [joints] and {[*ends, ""][0]} = "POINT", and '
                "give it with --names",
            ),
        )
        return found


@dataclass(frozen=True)
class Points:
    """3D points of one animal over time.

    Attributes:
        time_s: (n,) s since the first frame, increasing.
        names: of the P points.
        points_mm: (n, P, 3) mm, z up from the floor; NaN where missing.
        scores: (n, P) confidence of the program that measured them; None if not stated.
        individual: the animal's name in the file; '' if it has none.
        floor_mm: height of the floor along the file's upward axis, mm.
        words: (n,) a person's word for each frame; None if the file has none.
    """

    time_s: Array
    names: tuple[str, ...]
    points_mm: Array
    scores: Array | None
    individual: str
    floor_mm: float
    words: NDArray[np.str_] | None


# points (n, A, P, 3), names (P), and perhaps individuals (A), time_s (n), frames (n), scores
# (n, A, P) and words (n)
_Held = Mapping[str, Any]


def read_points(path: str | Path, names: PointNames) -> Points:
    """The 3D points of one animal from a file of another program.

    Args:
        path: .csv (a column per coordinate, as `nose_x`, or a row per frame and keypoint), .nc of
            movement, .mat of DANNCE, or .npz with `points_mm` (n, P, 3), `points` and `time_s`.
        names: what the file does not state.

    Raises:
        LiexError: the file cannot be read, holds 2D points, several animals of which none is
            chosen, too few frames, or times that do not increase.
    """
    return _read(path, names, several=False)[0]


def read_animals(path: str | Path, names: PointNames) -> list[Points]:
    """The 3D points of every animal in a file, or of the chosen one, see `read_points`.

    All stand on one floor.
    """
    return _read(path, names, several=True)


def _read(path: str | Path, names: PointNames, several: bool) -> list[Points]:
    source = Path(path)
    kind = source.suffix.lower()
    if kind not in READERS or not source.is_file():
        raise LiexError(
            f"3D points are read from {', '.join(READERS)} files, and {source} "
            f"is {'of another kind' if source.is_file() else 'not a file'}; name such a file"
        )
    try:
        return _checked(READERS[kind](source), names, several)
    except LiexError as error:
        raise LiexError(f"{source} {error}") from None
    except ModuleNotFoundError as error:
        raise LiexError(f"{source} needs {error.name}; {how_to_install('exchange')}") from None
    except Exception as error:  # other packages raise no specific type
        raise LiexError(
            f"{source} should hold 3D points, but: {one_line(error)}; docs/howto/points.md lists "
            "the forms that are read"
        ) from None


def _checked(held: _Held, names: PointNames, several: bool) -> list[Points]:
    """The points of the chosen animal, or of `several`, in mm, z up.

    Raises:
        LiexError: they cannot be used.
    """
    known = [str(name) for name in held.get("individuals", [names.individual or ""])]
    every = np.asarray(held["points"], float)
    labels = [str(name) for name in held.get("names", ())] or names.points
    labels = labels or [f"point_{k + 1}" for k in range(every.shape[2])]
    alone = names.individual or (known[0] if len(known) == 1 else None)
    chosen = known if several and names.individual is None else [alone]
    times, frames = held.get("time_s"), held.get("frames", np.arange(len(every)))
    time_s = np.asarray(frames, float) / (names.fps or 1.0)
    time_s = time_s if times is None else np.asarray(times, float)
    refuse(
        LiexError,
        (every.shape[-1] != 3, f"holds {_FLAT}"),
        (
            not {*chosen} <= {*known},
            f"holds the animals {', '.join(known)}; choose one with --individual",
        ),
        (
            every.shape[2] != len(labels) or len(set(labels)) != len(labels),
            f"has {every.shape[2]} points, and the names {', '.join(labels)}; each point needs a "
            "name of its own",
        ),
        (
            times is None and names.fps is None,
            "has no times, and the frame rate is needed; state it with --fps",
        ),
        (len(every) < _FEWEST, f"has {len(every)} frames, and {_FEWEST} are needed"),
        (
            time_s.shape != every.shape[:1],
            f"has {len(every)} frames and {time_s.size} times; each frame needs its own",
        ),
    )
    late = [*np.flatnonzero(~(np.diff(time_s) > 0)), -1][0]
    which = [known.index(str(name)) for name in chosen]
    points = _upright(every[:, which], names.up) * _UNITS_MM[names.unit]
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    heights = points[..., 2][np.isfinite(points[..., 2])]
    refuse(
        LiexError,
        (
            late >= 0,
            f"has frames {late} and {late + 1} at {time_s[late]:g} s and {time_s[late + 1]:g} s, "
            "and times should increase; sort the frames, or correct them",
        ),
        (not len(heights), "has no point in any frame; check the file"),
        (len(heights) and np.ptp(heights) == 0.0, f"has one height for all points: {_FLAT}"),
    )
    floor = (
        float(np.nanquantile(np.fmin.reduce(points[..., 2], axis=2), 0.05))
        if names.floor is None
        else names.floor * _UNITS_MM[names.unit]
    )
    points[..., 2] -= floor
    scores, words = held.get("scores"), held.get("words")
    return [
        Points(
            time_s - time_s[0],
            tuple(labels),
            points[:, k],
            None if scores is None else np.asarray(scores, float)[:, animal],
            known[animal],
            floor,
            None if words is None else np.asarray(words).astype(str),
        )
        for k, animal in enumerate(which)
    ]


def _upright(points: Array, up: str) -> Array:
    """Points (..., 3) turned, and not mirrored, so that the upward axis becomes z."""
    axis = "xyz".index(up[-1])
    turned = points[..., [(axis + 1) % 3, (axis + 2) % 3, axis]]
    return turned[..., [1, 0, 2]] * [1.0, 1.0, -1.0] if up[0] == "-" else turned


# Readers of single formats; `_checked` reports what is missing in their results.


def _read_csv(path: Path) -> _Held:
    """A table with a column per coordinate, or a row per frame and keypoint."""
    text = read_text(path)
    separator, _ = split_lines(text[:20_000].rpartition("\n")[0])
    decimal = "," if separator != "," and "," in text else "."
    table = pd.read_csv(io.StringIO(text), sep=separator, decimal=decimal)
    singular = {str(name).strip().lower().removesuffix("s"): name for name in table}
    columns = {
        what: table[next(singular[name] for name in known if name in singular)].to_numpy()
        for what, known in _COLUMNS.items()
        if any(name in singular for name in known)
    }
    return _long(columns) if "point" in columns else _wide(table, columns)


def _wide(table: pd.DataFrame, columns: _Held) -> _Held:
    """A column per coordinate: `nose_x, nose_y, nose_z[, nose_score]`, as Anipose writes."""
    found = {
        (parts[1], parts[2].lower()): column
        for column in map(str, table)
        if (parts := _COORDINATE.fullmatch(column))
    }
    whole = [name for name, axis in found if axis == "z" and {(name, "x"), (name, "y")} <= {*found}]
    refuse(
        LiexError,
        (
            not found,
            "should have columns such as nose_x, nose_y and nose_z, and has "
            f"{', '.join(map(str, table))[:200]}; rename them",
        ),
        (not whole, f"holds {_FLAT}"),
    )
    points = np.stack([table[[found[k, a] for a in "xyz"]].to_numpy(float) for k in whole], axis=1)
    stated = [[f"{k}_{word}" for k in whole] for word in _COLUMNS["score"]]
    scores = [table[one].to_numpy(float)[:, None] for one in stated if {*one} <= {*table}]
    return {
        "points": points[:, None],
        "names": whole,
        "scores": [*scores, None][0],
        **{name: columns[name] for name in ("time_s", "frames") if name in columns},
    }


def _long(columns: _Held) -> _Held:
    """A row per frame and keypoint, with columns of the keypoint, x, y and z."""
    when = next((name for name in ("time_s", "frames") if name in columns), "")
    lacking = [axis for axis in "xyz" if axis not in columns]
    refuse(
        LiexError,
        (lacking == ["z"], f"holds {_FLAT}"),
        (lacking or not when, "should have the columns frame or time, keypoint, x, y and z"),
    )
    alone = np.zeros(len(columns["point"]))
    (times, row), (known, point), (animals, animal) = (
        np.unique(column if column.dtype.kind in "if" else column.astype(str), return_inverse=True)
        for column in (columns[when], columns["point"], columns.get("individual", alone))
    )
    if len({*zip(row, animal, point, strict=True)}) < len(row):
        raise LiexError("has two rows of one point in one frame; each needs its own frame")
    values = [columns[name].astype(float) for name in (*"xyz", "score") if name in columns]
    points = np.full((len(times), len(animals), len(known), len(values)), np.nan)
    points[row, animal, point] = np.stack(values, axis=1)
    return {
        when: times,
        "points": points[..., :3],
        "names": known,
        "scores": points[..., 3] if "score" in columns else None,
        **({"individuals": animals} if "individual" in columns else {}),
    }


def _read_movement(path: Path) -> _Held:
    """Poses of movement, as netCDF; its later versions name dimensions in the singular."""
    import xarray

    held = xarray.load_dataset(path, engine="h5netcdf")
    held = held.rename({name: f"{name}s" for name in ("keypoint", "individual") if name in held})
    order = ("time", "individuals", "keypoints")
    return {
        "points": held["position"].transpose(*order, "space").to_numpy(),
        "names": held["keypoints"].to_numpy(),
        "individuals": held["individuals"].to_numpy(),
        "scores": held["confidence"].transpose(*order).to_numpy() if "confidence" in held else None,
        "frames" if str(held.attrs.get("time_unit")).startswith("frame") else "time_s": (
            held["time"].to_numpy()
        ),
    }


def _read_dannce(path: Path) -> _Held:
    """DANNCE's predictions: `pred` (n, 3, P) or (n, A, 3, P), and `sampleID`, perhaps `p_max`."""
    from scipy.io import loadmat

    held = loadmat(path, simplify_cells=True)
    points = np.moveaxis(np.asarray(held["pred"], float), -2, -1)
    points = points if points.ndim == 4 else points[:, None]
    sure = np.asarray(held.get("p_max", 0.0), float)
    count = np.ravel(held.get("sampleID", np.arange(len(points)))).astype(float)
    return {
        "points": points,
        "names": np.ravel(held.get("joint_names", ())),
        "scores": sure.reshape(points.shape[:3]) if sure.size == points[..., 0].size else None,
        "frames": (count - count[0]) / np.median(np.diff(count)),
        **({"individuals": range(points.shape[1])} if points.shape[1] > 1 else {}),
    }


def _read_npz(path: Path) -> _Held:
    """A NumPy archive: `points_mm` (n, P, 3), `points`, and perhaps `time_s`, `scores`, `label`."""
    check_npz(path, 4_000_000_000)
    with np.load(path, allow_pickle=False) as file:
        held = dict(file)
    return {
        "points": held["points_mm"][:, None],
        "names": held.get("points", held.get("names", ())),
        "time_s": held.get("time_s"),
        "scores": held["scores"][:, None] if "scores" in held else None,
        "words": held.get("label"),
    }


READERS: dict[str, Callable[[Path], _Held]] = {
    ".csv": _read_csv,
    ".nc": _read_movement,
    ".mat": _read_dannce,
    ".npz": _read_npz,
}
