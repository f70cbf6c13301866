"""Reader of MoSeq's extractions, results_00.h5: full depth images from cut-outs of the animal.

moseq2-extract keeps of every frame the height over the background in a square about the animal,
cut at whole pixels and turned until the animal lies level, by half a turn more where a classifier
found its head on the left:

    cut-out(q) = height(R(angle) (q - c) + c + corner),   corner = trunc(centroid - side / 2),
    c = (side / 2, side / 2),   height = whole mm of background - depth, 0 outside of [low, high].

Here it is turned back and subtracted from the background. Pixels at the outline, which turning
mixes with the floor, are weighted by the share of the animal in them. Holes in the outline were
unread or higher than `high`; they are unread again. MoSeq's scalars, which it measured before it
turned anything, are kept as they are.

The layout is that of moseq2-extract 0.1.3 to 1.2, and of earlier versions where it differs in names
only.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from liex_lab.errors import RecordingError, expecting, needing, one_line
from liex_lab.optics.camera import Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate
from liex_lab.recordings.formats.moseq import (
    KINECT,
    NOMINAL_HZ,
    Metadata,
    assumed_camera,
    stated_in,
)
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.recordings.timestamp_files import UNITS, Stamps
from liex_lab.recordings.timestamps import (
    Times,
    from_rate,
    make_monotone,
    match_counts,
    unpaired,
)
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    import h5py

FORMAT = "moseq-results"
# scalars that all others follow from
_SIZES = ("length_px", "width_px", "area_px", "height_ave_mm")
SHAPE = ("centroid_x_px", "centroid_y_px", "angle", *_SIZES)
_EXTRACTION = "metadata/extraction/"
_PARAMETERS = f"{_EXTRACTION}parameters/"
_BLOCK = 1024  # frames read at once, at least a chunk of the file: chunks span many frames
# of the least height: lower pixels of a cut-out count as floor. Real outlines come back neither
# wider nor narrower by more than 0.2 px with it (raw frame of a Kinect v2, turned to 36 directions)
_OWN = 0.85
_AGREES_MM = 3.0  # of the first frame put together again, from the raw one in the file


def open_results(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open the results of moseq2-extract as a recording of full frames.

    Args:
        path: the file results_00.h5.
        camera: overrides the camera.toml beside it and the typical camera.
        fps: frame rate, Hz; used only if there are no time stamps.
        progress: not used; the file has an index.

    Raises:
        RecordingError: the file is damaged or holds no such results, or the camera is unknown.
        MissingPackageError: h5py is not installed.
    """
    with needing("exchange", f"reading {path}"):
        import h5py
    with expecting(
        RecordingError,
        f"{path} should be the results of moseq2-extract (HDF5)",
        OSError,
        RuntimeError,
        KeyError,  # as h5py reports damage
        advice="copy it again, or give the recording itself",
    ):
        file = h5py.File(path, "r")
        with closing_on_error(file):
            return _recording(path, file, camera, fps)


def _recording(path: Path, file: h5py.File, camera: Lens | None, fps: float | None) -> Recording:
    camera_file = CameraFile.read(path.parent / CAMERA_FILE)
    problems = list(camera_file.problems)
    doubts: list[str] = []
    results = _Results(path, file, problems)
    metadata = _metadata(file)
    results.check_first_frame(doubts)
    monotone = make_monotone(_times(path, file, results, camera_file, fps, problems, doubts))
    problems += [*metadata.problems, *filter(None, [monotone.problem])]
    height, width = results.scene.shape
    recording = Recording(
        name=path.stem if path.parent.name != "proc" else f"{path.parents[1].name}_{path.stem}",
        format=FORMAT,
        camera=camera_file.camera(width, height, camera)
        if camera is not None or camera_file.intrinsics
        else assumed_camera(path, (width, height), metadata.camera or KINECT, metadata, problems),
        times_ns=monotone.times_ns,
        read=results.read,
        sources=[path],
        problems=problems,
        close=file.close,
        faults=monotone.faults,
        doubts=doubts,
        metadata={"profile": results.facts(), **metadata.facts, **camera_file.metadata},
    )
    recording.measured = results.scalars()
    return recording


class _Results:
    """The content of the file: cut-outs, where they were, and the scene behind them.

    Attributes:
        scene: (H, W) float32 mm, the background; 0 where unread.
        side: of a cut-out, px.
    """

    def __init__(self, path: Path, file: h5py.File, problems: list[str]) -> None:
        self._path = path
        self._file = file
        self._lock = Lock()
        self._block: tuple[int, NDArray[Any] | None] = (-1, None)
        self._problems = problems
        frames: Any = file.get("frames")
        if getattr(frames, "ndim", 0) != 3 or frames.dtype.kind not in "ui" or not len(frames):
            raise RecordingError(
                f"{path} should be the results of moseq2-extract, but holds no cut-outs (frames); "
                "give results_00.h5 of an extraction, or a recording"
            )
        self.frames = frames
        self.side = int(frames.shape[1])
        if frames.shape[1] != frames.shape[2]:
            raise RecordingError(
                f"{path} holds cut-outs of {frames.shape[2]} x {frames.shape[1]} pixels, and how "
                "MoSeq turns any but squares is not known; extract it again with a square crop-size"
            )
        chunk = (frames.chunks or (1,))[0]
        self._n_rows = chunk * max(1, _BLOCK // chunk)
        self._background(problems)
        self._places(problems)
        low, high = (_number(file, f"{_PARAMETERS}{end}_height") for end in ("min", "max"))
        self._low = 10.0 if low is None else low
        high = 100.0 if high is None else high
        problems.append(
            f"MoSeq keeps heights of {self._low:g} to {high:g} mm in a square of {self.side} px "
            "about the animal; what is lower (most of the tail, paws), higher (unread here) or "
            "farther away is lost, joints there are extrapolated, and the background never changes"
        )

    def _background(self, problems: list[str]) -> None:
        """The scene behind the animal, the level of heights, and the corner of MoSeq's crop."""
        roi = _array(self._file, f"{_EXTRACTION}roi")
        stored = _array(self._file, f"{_EXTRACTION}background")
        self.floor_mm = _number(self._file, f"{_EXTRACTION}true_depth")
        if roi is None or not roi.any() or roi.ndim != 2:
            raise RecordingError(
                f"{self._path} holds no region of interest ({_EXTRACTION}roi), so where its "
                "cut-outs lie in the image is not known; extract it again, or give the recording"
            )
        if stored is None or stored.shape != roi.shape:
            if self.floor_mm is None:
                raise RecordingError(
                    f"{self._path} holds neither a background ({_EXTRACTION}background) nor the "
                    "distance of the floor (true_depth), so its heights are over nothing known; "
                    "extract it again, or give the recording"
                )
            problems.append(
                f"the file holds no background of the image's size, so a flat floor at "
                f"{self.floor_mm:g} mm was taken: heights over a floor that is not flat are wrong, "
                "and there are no walls"
            )
            stored = np.full(roi.shape, self.floor_mm)
        self.scene = np.clip(np.nan_to_num(stored), 0, 65_535).astype(np.float32)
        self._level = np.floor(self.scene)  # MoSeq cuts heights to whole mm, and depth is whole
        if self.floor_mm is not None and _number(self._file, f"{_PARAMETERS}graduate_walls"):
            self._level = np.maximum(self._level, np.floor(np.float32(self.floor_mm)))
        rows, columns = np.nonzero(roi)
        self.corner = np.array([columns.min(), rows.min()])
        self._middle = self.corner / 2 + [columns.max() / 2, rows.max() / 2]

    def _places(self, problems: list[str]) -> None:
        """Where each cut-out was, and how it was turned."""
        names = ("centroid_x_px", "centroid_x"), ("centroid_y_px", "centroid_y"), ("angle",)
        found = [_array(self._file, *(f"scalars/{name}" for name in own)) for own in names]
        if any(one is None or one.shape != self.frames.shape[:1] for one in found):
            raise RecordingError(
                f"{self._path} does not hold centroid and angle of every frame (scalars), so its "
                "cut-outs cannot be put back; extract it again, or give the recording"
            )
        x, y, angle = (np.asarray(one, float) for one in found)
        flips = _array(self._file, f"{_EXTRACTION}flips", "metadata/flips")
        if flips is None or flips.shape != x.shape:
            flips = np.zeros(len(x))
            problems.append(
                "the file does not state which cut-outs were flipped, so none was taken to be; "
                "flipped ones lie up to one pixel off"
            )
        self._flips = flips.astype(np.bool_)
        self._angle = angle - np.pi * self._flips
        self.known = np.isfinite(x) & np.isfinite(y) & np.isfinite(angle) & ((x != 0) | (y != 0))
        if not self.known.any():
            raise RecordingError(
                f"{self._path} holds no frame in which MoSeq found the animal; extract it again"
            )
        if not self.known.all():
            problems.append(
                f"{int((~self.known).sum())} of {len(x)} frames hold no animal, since MoSeq found "
                "none or its extraction was interrupted; they show the background only"
            )
        half = self.side // 2
        centre = np.nan_to_num(np.stack([x, y], axis=1))
        self._from = np.trunc(centre - half).astype(int) + self.corner

    def facts(self) -> dict[str, Any]:
        """What MoSeq's own numbers refer to, for session.json."""
        known = {
            "moseq_corner_px": self.corner.tolist(),
            "moseq_middle_px": self._middle.tolist(),
            "moseq_floor_mm": self.floor_mm,
        }
        return {name: value for name, value in known.items() if value is not None}

    def scalars(self) -> dict[str, NDArray[np.float64]]:
        """MoSeq's own scalars of every frame; none if one of `SHAPE` is missing."""
        stored: Any = self._file["scalars"]
        found = {name: np.asarray(one, float) for name, one in stored.items() if one.ndim == 1}
        found = {name: one for name, one in found.items() if one.shape == self.known.shape}
        return found if {*SHAPE} <= {*found} else {}

    def read(self, index: int) -> Depth:
        """Depth (H, W) float32 mm of a frame, wholly unread where the file is damaged."""
        depth = self.scene.copy()
        if not self.known[index]:
            return depth
        cut = self._cut_out(index)
        if cut is None:
            return np.zeros_like(depth)
        height, is_animal, is_hole = self._turned_back(cut, index)
        left, top = self._from[index]
        rows = slice(max(0, top), max(0, top + self.side))
        columns = slice(max(0, left), max(0, left + self.side))
        part, level = depth[rows, columns], self._level[rows, columns]
        first = np.s_[rows.start - top :, columns.start - left :]
        own = np.s_[: part.shape[0], : part.shape[1]]
        part[is_hole[first][own]] = 0
        found = np.maximum(level - height[first][own], 0)
        np.copyto(part, found, where=is_animal[first][own])
        return depth

    def _turned_back(
        self, cut: NDArray[Any], index: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
        """Heights (S, S) mm in the image's own directions, the animal, and holes in it."""
        half = self.side // 2
        turn = cv2.getRotationMatrix2D((half, half), -float(np.rad2deg(self._angle[index])), 1)
        own = cut >= _OWN * self._low
        kept = np.stack([np.where(own, np.maximum(cut, self._low), 0), own], axis=-1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        back = cv2.warpAffine(kept.astype(np.float32), turn, (self.side, self.side), flags=flags)
        height, share = np.moveaxis(back, -1, 0)
        is_animal = share >= 0.5
        height = np.rint(height / np.maximum(share, 0.5))
        return height, is_animal, binary_fill_holes(is_animal) & ~is_animal

    def _cut_out(self, index: int) -> NDArray[Any] | None:
        """A cut-out as it was before it was flipped; None if the block of frames is damaged."""
        at = index - index % self._n_rows
        with self._lock:
            if self._block[0] != at:
                try:
                    self._block = at, self.frames[at : at + self._n_rows]
                except OSError as error:
                    self._block = at, None
                    sentence = (
                        f"the {self._n_rows} frames from {at} on are damaged "
                        f"({one_line(error)}), and were taken as wholly unread"
                    )
                    self._problems += [sentence] * (sentence not in self._problems)
            block = self._block[1]
        if block is None:
            return None
        return block[index - at, ::-1, ::-1] if self._flips[index] else block[index - at]

    def check_first_frame(self, doubts: list[str]) -> None:
        """Compare the first frame, put together again, with the raw one that the file holds."""
        raw = _array(self._file, f"{_EXTRACTION}first_frame")
        raw = None if raw is None else np.squeeze(raw)
        trim = _array(self._file, f"{_PARAMETERS}frame_trim")
        frame = self.read(0)
        if raw is None or raw.shape != self.scene.shape:
            doubts.append(
                "the file holds no raw first frame, with which frames put together again could be "
                "compared; check the replay before you trust them"
            )
            return
        animal = (frame != self.scene) & (frame > 0) & (raw > 0)
        if not animal.any() or (trim is not None and np.any(trim)):
            return
        off = float(np.median(np.abs(frame[animal] - raw[animal])))
        if off > _AGREES_MM:
            doubts.append(
                f"frame 0, put together again, differs from the raw one in the file by {off:.1f} "
                f"mm (median over the animal), where {_AGREES_MM:g} mm or less were expected; the "
                "file may be of another version of MoSeq, so do not trust its frames"
            )


def _array(file: h5py.File, *names: str) -> NDArray[Any] | None:
    """The first of these data sets that the file holds; None if all are missing or empty."""
    for name in names:
        found = file.get(name)
        if getattr(found, "shape", None) is not None:
            return np.asarray(found[()])
    return None


def _number(file: h5py.File, name: str) -> float | None:
    found = _array(file, name)
    if found is None or found.size != 1 or found.dtype.kind not in "biuf":
        return None
    return float(found.reshape(())) if np.isfinite(found).all() else None


def _metadata(file: h5py.File) -> Metadata:
    """The session's metadata.json, of which the file holds a copy."""
    document: dict[str, Any] = {}
    for group in ("metadata/acquisition", "metadata/extraction"):  # the latter before 0.1.3
        if document or group not in file:
            continue
        for key, entry in file[group].items():
            if getattr(entry, "shape", None) is not None and entry.size <= 16:
                value = entry[()]
                plain = value.tolist() if hasattr(value, "tolist") else value
                document[str(key)] = (
                    plain.decode(errors="replace") if isinstance(plain, bytes) else plain
                )
    kind = file.get(f"{_PARAMETERS}camera_type")
    if kind is not None and kind.shape == () and b"azure" in bytes(kind[()]):
        document["camera_type"] = "azure"
    return stated_in(document)


def _times(
    path: Path,
    file: h5py.File,
    results: _Results,
    camera_file: CameraFile,
    fps: float | None,
    problems: list[str],
    doubts: list[str],
) -> Times:
    """The stamps in the file, or a constant rate."""
    n = len(results.frames)
    hz = rate(fps, "the call") or camera_file.fps
    stored = _array(file, "timestamps", "metadata/timestamps")
    if stored is None or not len(stored):
        problems.append(
            f"the file holds no time stamps, so a constant {hz or NOMINAL_HZ:g} frames/s was "
            f"assumed, {'as stated' if hz else 'which is the usual rate'}; dropped frames are not "
            "known"
        )
        return from_rate(n, hz or NOMINAL_HZ)
    rows = [(line, [str(value)]) for line, value in enumerate(stored.ravel().tolist(), start=1)]
    unit = camera_file.time_unit
    stamps = replace(Stamps.of(path, rows, 0), ns_per_unit=UNITS[unit or "ms"], named=bool(unit))
    times = stamps.times(hz, problems, doubts, NOMINAL_HZ)
    if len(times) < n:
        doubts.append(unpaired("frames", "timestamps"))
        problems += match_counts(n, len(times), "frames", "timestamps")
    return times[:n]
