"""Reader of PrimeSense and OpenNI recordings (.oni): 16-bit depth, raw or in OpenNI's 16z codecs.

Intrinsics come from the caller, a camera.toml, a property of our own, or the stated field of view:
f = (n / 2) / tan(fov / 2), with the optical axis at half the size, as OpenNI has it. Mirrored
pictures are turned back, and a cropped one is put into its full picture.
"""

from __future__ import annotations

import math
from pathlib import Path
from threading import Lock

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate
from liex_lab.recordings.formats._oni_kernels import WORST_BYTES_A_PIXEL, unpack_16z
from liex_lab.recordings.formats.oni_file import (
    FIELD_OF_VIEW,
    INTRINSICS,
    OLD_LENS,
    PLANE_DISTANCE,
    PLANE_PIXEL,
    DepthNode,
    FrameFormat,
    OniFile,
    index_file,
)
from liex_lab.recordings.frame import Depth, depth_mm
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import (
    MonotoneTimes,
    from_rate,
    in_order_of_sensor,
    start_of_clock,
)
from liex_lab.runtime.progress import Progress, silent

RAW = b"NONE"
WITH_TABLE = b"16zT"
WITHOUT_TABLE = b"16zP"
_CODECS = (RAW, WITH_TABLE, WITHOUT_TABLE)
_UNIT_MM = {100: 1.0, 101: 0.1}  # OpenNI's pixel formats of depth
_SHIFTS = (102, 103)
_MOST_PIXELS = 1 << 24  # a frame of a damaged header may not ask for all the memory there is
_LATEST_US = 2**62 // 1000
_NOMINAL_HZ = 30.0
_N_PROBED = 5

# of PrimeSense's reference design: 120 mm / (2 x 0.1052 mm)
_VGA_FOCAL = 570.342
_VGA_WIDTH = 640
_SENSOR_WIDTH = 1280  # pixels that the plane's pixel size (ZPPS) is stated for
_USUAL_SIZES = ((160, 120), (320, 240), (640, 480), (1280, 960), (1280, 1024))
_FIELDS_OF_VIEW = (math.radians(5.0), math.radians(170.0))


class OniFrames:
    """Frames of one depth node, fetched from the file one at a time."""

    def __init__(
        self,
        file: OniFile,
        node: DepthNode,
        form: FrameFormat,
        how: CameraFile,
        problems: list[str],
    ) -> None:
        """Tabulate the depth of every stored value.

        Args:
            file: the open file.
            node: the depth node with the positions of its frames.
            form: the picture format that frames must agree with to be of this recording.
            how: a camera.toml beside the file, for its unit_mm (a further factor) and unread.
            problems: the recording's sentences, appended to when a damaged frame is met.
        """
        self._file = file
        self._node = node
        self._form = form
        self._problems = problems
        self._formats = list(node.formats)
        self._unit_mm = _UNIT_MM[form.pixel_format] * how.unit_mm
        self._unread = how.unread
        self._meaning = depth_mm(np.arange(1 << 16, dtype=np.uint16), self._unit_mm, self._unread)
        self._bad: set[int] = set()
        self._lock = Lock()

    def read(self, number: int) -> Depth:
        """Depth of one frame; one that is damaged or of another size is wholly unread.

        Args:
            number: index of the frame in the node.

        Returns:
            (H, W) float32 mm, 0 where unread.
        """
        depth = self.decode(number)
        if depth is not None:
            return depth
        if number not in self._bad:
            self._bad.add(number)
            self._problems.append(
                f"frame {number} is damaged or not of {self._form.width} x {self._form.height} "
                "pixels, and was taken as wholly unread"
            )
        return np.zeros((self._form.height, self._form.width), np.float32)

    def decode(self, number: int) -> Depth | None:
        """Depth of one frame, without a replacement for damaged ones.

        Args:
            number: index of the frame in the node.

        Returns:
            (H, W) float32 mm, 0 where unread; None where it is damaged or of another size.
        """
        form = self._formats[self._node.format_of[number]]
        if form is None or form.constant != self._form.constant:
            return None
        x, y, width, height = form.part
        if not (width and height and x + width <= form.width and y + height <= form.height):
            return None
        part = self._unpack(self._payload(number, width * height), width * height)
        if part is None:
            return None
        depth = part.reshape(height, width)
        if (width, height) != (form.width, form.height):
            depth = np.zeros((form.height, form.width), np.float32)
            depth[y : y + height, x : x + width] = part.reshape(height, width)
        # a mirror image has the animal's left and right exchanged
        return np.ascontiguousarray(depth[:, ::-1]) if form.mirrored else depth

    def _payload(self, number: int, n_pixels: int) -> bytes:
        """The stored bytes of a frame; none where they cannot be so many pixels."""
        size = self._node.sizes[number]
        # the code, the longest table, and the counts before both
        most = WORST_BYTES_A_PIXEL * n_pixels + (1 << 17) + 4
        with self._lock:
            raw = self._file.read(self._node.positions[number], size) if size <= most else b""
        return raw if len(raw) == size else b""

    def _unpack(self, payload: bytes, n_pixels: int) -> Depth | None:
        if self._node.codec != RAW:
            stream = np.frombuffer(payload, np.uint8)
            return unpack_16z(stream, self._meaning, n_pixels, self._node.codec == WITH_TABLE)
        if len(payload) != 2 * n_pixels:
            return None
        return depth_mm(np.frombuffer(payload, "<u2"), self._unit_mm, self._unread)


def open_oni(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open the depth of an .oni file as a recording.

    Args:
        path: the .oni file.
        camera: comes before whatever the files state.
        fps: frame rate, Hz; used only where every frame has the same time.
        progress: told how many MB were indexed.

    Returns:
        The recording, of the first depth node that holds frames.

    Raises:
        RecordingError: there are no depth frames, they cannot be decoded, or the camera is not
            known.
    """
    file = OniFile(path)
    try:
        return _open(path, file, camera, fps, progress)
    except BaseException:
        file.close()
        raise


def _open(
    path: Path, file: OniFile, camera: Lens | None, fps: float | None, progress: Progress
) -> Recording:
    nodes, others = index_file(file, progress)
    problems: list[str] = []
    node = _choose(path, file, nodes, others, problems)
    form = _format(path, node, problems)
    n = len(node)
    whole = file.whole and (node.n_stated is None or node.n_stated <= len(node))
    if node.n_stated not in (None, n):
        problems.append(
            f"{path.name} promises {node.n_stated} frames of {node.name}, and {n} are in it"
        )
    if not whole:
        problems.append(
            f"{path.name} is cut or damaged; {n} whole frame{'' if n == 1 else 's'} can be read "
            "from it"
        )
    camera_file = CameraFile.read(path.parent / CAMERA_FILE)
    problems += camera_file.problems
    the_camera = _camera(path, node, form, camera_file, camera, problems)
    monotone = _times(node, form, fps, problems)
    times = monotone.times_ns
    frames = OniFrames(file, node, form, camera_file, problems)
    if not any(
        frames.decode(i) is not None
        for i in np.linspace(0, n - 1, min(n, _N_PROBED)).astype(int).tolist()
    ):
        raise RecordingError(
            f"{path} states pictures of {form.width} x {form.height} pixels, but its frames do not "
            "unpack to that; it is damaged, so copy it again"
        )
    start = start_of_clock(int(times[0]))
    return Recording(
        name=path.resolve().stem,
        format="oni",
        camera=the_camera,
        times_ns=times,
        read=frames.read,
        sources=[path],
        problems=problems,
        truncated=not whole,
        close=file.close,
        faults=monotone.faults,
        stored=monotone.order,
        metadata=({"session_start_time": start} if start else {}) | camera_file.metadata,
    )


def _choose(
    path: Path, file: OniFile, depth: list[DepthNode], others: set[str], problems: list[str]
) -> DepthNode:
    """The first depth node with frames; nodes are chosen by kind, for names may be anything."""
    nodes = [node for node in depth if len(node)]
    cut = "" if file.whole else "the file is cut or damaged, and "
    if not nodes:
        named = sorted({node.name for node in depth} | others)
        what = f"its nodes are {', '.join(named)}" if named else "it holds no node of any kind"
        raise RecordingError(
            f"{path} holds no depth frames: {cut}{what}; give a recording of the depth camera"
        )
    node = nodes[0]
    if len(nodes) > 1:
        problems.append(
            f"{path.name} holds frames of {len(nodes)} depth cameras; those of the first, "
            f"{node.name}, are read"
        )
    if node.codec not in _CODECS:
        raise RecordingError(
            f"{path} holds its depth in the code {node.codec.decode('latin-1')!r}, and {cut}NONE, "
            "16zT and 16zP can be read; record it again without compression"
        )
    return node


def _format(path: Path, node: DepthNode, problems: list[str]) -> FrameFormat:
    """The format that most frames have; those with another size or unit will be unread."""
    count = np.bincount(
        np.frombuffer(node.format_of, node.format_of.typecode), minlength=len(node.formats)
    )
    form = list(node.formats)[int(count.argmax())]
    if form is None:
        raise RecordingError(
            f"{path} does not state the size of its pictures (xnMapOutputMode); copy it again"
        )
    if not 0 < form.width * form.height <= _MOST_PIXELS:
        raise RecordingError(
            f"{path} states pictures of {form.width} x {form.height} pixels, which no depth camera "
            "has; it is damaged, so copy it again"
        )
    if form.pixel_format not in _UNIT_MM:
        what = (
            "the sensor's raw shifts"
            if form.pixel_format in _SHIFTS
            else f"the unit {form.pixel_format}"
        )
        raise RecordingError(
            f"{path} holds {what} (oniPixelFormat), and depth in steps of 1 mm or 0.1 mm can be "
            "read; record it again as depth"
        )
    others = sum(
        int(n)
        for each, n in zip(node.formats, count, strict=True)
        if not each or each.constant != form.constant
    )
    if others:
        problems.append(
            f"{others} of {len(node)} frames have another size or unit than {form.width} x "
            f"{form.height} pixels, and are taken as wholly unread"
        )
    if form.mirrored:
        problems.append(
            "the camera delivered mirror images (xnMirror); left and right were put back in their "
            "places"
        )
    if form.part[2:] != (form.width, form.height):
        x, y, width, height = form.part
        problems.append(
            f"the camera recorded only {width} x {height} pixels at ({x}, {y}) of its {form.width} "
            f"x {form.height}; the rest is unread"
        )
    return form


def _times(
    node: DepthNode, form: FrameFormat, fps: float | None, problems: list[str]
) -> MonotoneTimes:
    """Microseconds as ns; a rate where the clock stood still."""
    stamps = np.frombuffer(node.times_us, node.times_us.typecode)
    n = len(stamps)
    if n > 1 and np.all(stamps == stamps[0]):
        stated = rate(fps, "the call")
        hz = stated or float(form.fps if 0 < form.fps <= 1000 else _NOMINAL_HZ)
        origin = (
            "as stated"
            if stated
            else "which the file names as its rate; state fps if yours differs"
        )
        problems.append(
            f"all frames have the same time stamp, so a constant {hz:g} frames/s was assumed, "
            f"{origin}"
        )
        return in_order_of_sensor(from_rate(n, hz))
    order = np.arange(n)
    sane = np.maximum.accumulate(np.where(stamps <= _LATEST_US, order, 0))
    if n_wild := int((sane != order).sum()):
        problems.append(
            f"{n_wild} of {n} time stamps are damaged, for they are later than any clock; these "
            "frames were taken to follow the one before at once"
        )
    times_us = np.minimum(stamps[sane], np.uint64(_LATEST_US)).astype(np.int64)
    monotone = in_order_of_sensor(times_us * 1000 + (order - sane))
    problems += [monotone.problem] if monotone.problem else []
    return monotone


def _camera(
    path: Path,
    node: DepthNode,
    form: FrameFormat,
    camera_file: CameraFile,
    stated: Lens | None,
    problems: list[str],
) -> Camera:
    """Stated by the caller, or else in a camera.toml beside the file, or else what the camera said
    of itself.
    """
    # a camera.toml comes first here: what is in the file is the design of the make and no
    # calibration of this camera
    if stated is not None or camera_file.intrinsics:
        return camera_file.camera(form.width, form.height, stated)
    ours = node.numbers(INTRINSICS, "<dddd")
    if (
        ours is not None
        and np.isfinite(ours).all()
        and _can_be((ours[0], ours[1]), (form.width, form.height))
    ):
        source = f"intrinsics in the .oni file ({INTRINSICS})"
        return Camera(ours[0], ours[1], ours[2], ours[3], form.width, form.height, source=source)
    focal, source = _stated_focal(node, form, problems)
    if focal is None and (form.width, form.height) in _USUAL_SIZES:
        focal = (_VGA_FOCAL * form.width / _VGA_WIDTH,) * 2
        source = "typical PrimeSense"
        problems.append(
            "the file states no field of view, so the intrinsics of a typical PrimeSense camera "
            "were taken; state your camera's own in a camera.toml beside the recording"
        )
    if focal is None:
        raise RecordingError(
            f"{path} states no field of view for its {form.width} x {form.height} pixels; write a "
            "camera.toml beside it with [camera], fx = ..., fy = ..., cx = ... and cy = ... in "
            "pixels"
        )
    # OpenNI places the optical axis at half the size, counted as we count pixels
    cx = form.width / 2 if not form.mirrored else form.width - 1 - form.width / 2
    return Camera(*focal, cx, form.height / 2, form.width, form.height, source=source)


def _stated_focal(
    node: DepthNode, form: FrameFormat, problems: list[str]
) -> tuple[tuple[float, float] | None, str]:
    """Focal lengths (fx, fy) px and where they come from; (None, "") where the file states none
    that can be.
    """
    size = form.width, form.height
    found: list[tuple[tuple[float, float], str]] = []
    if (view := node.numbers(FIELD_OF_VIEW, "<dd")) is not None and all(
        0 < angle < math.pi for angle in view
    ):
        fx, fy = (n / 2 / math.tan(angle / 2) for n, angle in zip(size, view, strict=True))
        found.append(((fx, fy), "field of view in the .oni file (xnFOV)"))
    if (plane := node.numbers(OLD_LENS, "<ddd")) is not None and plane[1] * plane[2] > 0:
        focal = plane[0] / (plane[1] * plane[2])
        found.append(((focal, focal), f"lens in the .oni file ({OLD_LENS})"))
    distance = node.number(PLANE_DISTANCE)
    pixel = node.numbers(PLANE_PIXEL, "<d")
    if distance is not None and pixel is not None and pixel[0] > 0:
        focal = distance / pixel[0] * form.width / _SENSOR_WIDTH
        found.append(((focal, focal), "lens in the .oni file (ZPD and ZPPS)"))
    for focal_lengths, source in found:
        if _can_be(focal_lengths, size):
            return focal_lengths, source
        problems.append(
            f"the {source} cannot be: focal lengths of {focal_lengths[0]:g} and "
            f"{focal_lengths[1]:g} px"
        )
    return None, ""


def _can_be(focal: tuple[float, float], size: tuple[int, int]) -> bool:
    """Whether focal lengths belong to a lens, and to pixels about as wide as high."""
    if not all(math.isfinite(f) and f > 0 for f in focal) or not 0.5 < focal[0] / focal[1] < 2.0:
        return False
    views = [2 * math.atan(n / 2 / f) for n, f in zip(size, focal, strict=True)]
    return all(_FIELDS_OF_VIEW[0] < view < _FIELDS_OF_VIEW[1] for view in views)
