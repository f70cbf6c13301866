"""Selection of the depth topic in an MCAP file or ROS bag, with its calibration and its clock.

One walk over the file finds the topics whose first message is depth, the calibrations, and further
statements of known programs (`Statements`). The calibration with the same frame_id is used, nearest
by topic name, and mapped onto the image by its binning and region of interest; a rectified topic
uses P instead of K. Stamps are the sensor's, or the times of sending or logging if images have
none.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, RecordingError, UnknownCameraError
from liex_lab.optics.camera import Camera, Distortion, Lens, is_central
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, fitting, is_infrared
from liex_lab.recordings.formats.messages.messages import (
    CLOUD_SCHEMAS,
    SUFFIX,
    Calibration,
    Channel,
    DamagedChunk,
    DamagedMessage,
    Envelope,
    IndexedMessages,
    MessageFile,
    MessagePlace,
    PackFacts,
    Parser,
    Statement,
    Statements,
    calibration_in,
    printable,
)
from liex_lab.recordings.formats.messages.parsers import (
    decode_message,
    image_size,
    parser_of,
    plain_schema,
    stated_kind,
)
from liex_lab.recordings.frame import PLAUSIBLE_MM, Depth, unread_where_damaged
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.recordings.timestamps import in_order_of_sensor, start_of_clock
from liex_lab.runtime.progress import Progress

# expected message types, for errors
_EXPECTED = (
    "expected foxglove.RawImage or CompressedImage, or sensor_msgs Image or CompressedImage, with "
    "the encoding 16UC1, mono16 or 32FC1 or as 16-bit PNG, or a point cloud"
)
_LIMIT_NS = 2**62  # the year 2116
_DAMAGE = (ValueError, TypeError, KeyError, OverflowError, struct.error, DamagedChunk)
# most calibrations compared per topic: different ones, and those listed by an index
_N_COMPARED = 12
_STATE_IT = (
    "state the depth camera's numbers with --set camera.fx=... --set camera.fy=... --set "
    "camera.cx=... --set camera.cy=..."
)


@dataclass
class _Topic:
    """The depth messages of one topic, in file order, and properties of the first one.

    Attributes:
        channel: topic, schema and encoding.
        parse: parser of a message's bytes.
        frame_id: name of the camera's frame.
        size: width and height, px; (0, 0) for unordered points.
        metric: whether its values are metres by convention.
        order: (m,) numbers of messages already passed to a recording, by row.
        rows: (6 n,) for each message the times of logging and of sending (0 if absent) and the
            sensor's stamp, ns; chunk, offset and length.
    """

    channel: Channel
    parse: Parser
    frame_id: str
    size: tuple[int, int]
    metric: bool = False
    order: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    rows: array[int] = field(default_factory=lambda: array("q"))

    @property
    def name(self) -> str:
        """Name of the topic."""
        return self.channel.topic

    def add(self, message: Envelope, stamp_ns: int) -> None:
        """Record a message.

        Args:
            message: the message from the walk.
            stamp_ns: its stamp, ns.

        Raises:
            DamagedMessage: one of its times is beyond the year 2116.
        """
        if max(message.log_time_ns, abs(stamp_ns)) >= _LIMIT_NS:
            raise DamagedMessage("a message's time cannot be")
        sent_ns = min(message.publish_time_ns, _LIMIT_NS)
        self.rows.extend((message.log_time_ns, sent_ns, stamp_ns, *message.place))

    def add_all(self, listed: IndexedMessages) -> None:
        """Record messages listed by an index.

        Args:
            listed: the messages.

        Raises:
            DamagedMessage: a time is beyond the year 2116; the other messages are recorded.
        """
        logged = listed.log_time_ns
        sent = logged if listed.publish_time_ns is None else listed.publish_time_ns
        stamps = logged if listed.stamp_ns is None else listed.stamp_ns
        good = (logged < _LIMIT_NS) & (stamps < _LIMIT_NS) & (stamps > -_LIMIT_NS)
        times = [one.astype(np.int64) for one in (logged, np.minimum(sent, _LIMIT_NS), stamps)]
        self.rows.frombytes(np.column_stack([*times, listed.places])[good].tobytes())
        if not good.all():
            raise DamagedMessage("a message's time cannot be")

    def forget(self, chunk: int) -> None:
        """Remove the messages of a chunk and of later ones, which the next walk will return again.

        Args:
            chunk: number of the chunk; its messages are at the end.
        """
        while self.rows and self.rows[-3] >= chunk:
            del self.rows[-6:]


@dataclass
class _Found:
    """Contents of a file, as far as it was walked.

    Attributes:
        parsers: by channel; None for irrelevant channels.
        depths: the depth topics by channel.
        calibrations: the different calibrations by topic, each with the time of logging, ns, of its
            first message.
        listed: time of logging, ns, and place of unread calibrations, by channel.
        stated: statements of a known program about its recording.
        read: the channels with a readable message.
        failed: error of a channel's unreadable message.
        kinds: type of the images of a channel without depth.
    """

    parsers: dict[Channel, Parser | None] = field(default_factory=dict)
    depths: dict[Channel, _Topic] = field(default_factory=dict)
    calibrations: dict[str, list[tuple[int, Calibration]]] = field(default_factory=dict)
    listed: dict[Channel, list[tuple[int, MessagePlace]]] = field(default_factory=dict)
    stated: Statements = field(default_factory=Statements)
    read: set[Channel] = field(default_factory=set)
    failed: dict[Channel, str] = field(default_factory=dict)
    kinds: dict[Channel, str] = field(default_factory=dict)

    def unreadable(self) -> list[str]:
        """Sentences about channels without any readable message."""
        whys = {c.topic: why for c, why in self.failed.items() if c not in self.read}
        return [f"{printable(topic)}: {printable(why, 200)}" for topic, why in whys.items()]


def _frame_reader(
    file: MessageFile,
    topic: _Topic,
    places: NDArray[np.int64],
    camera: Camera,
    step_mm: float,
    unread: Sequence[float],
) -> Callable[..., Depth | str]:
    """The function that reads depth of one image of a topic, or what is wrong with it.

    Args:
        file: the open file.
        topic: the topic.
        places: (n, 3) chunk, offset and length of each image's message.
        camera: the camera of the recording.
        step_mm: mm per step of 16-bit depth.
        unread: values that mean "no reading", from a camera.toml.
    """
    lock = Lock()

    def read(number: int, scale: float = 1.0) -> Depth | str:
        """Depth (H, W) float32 mm of the image `number`, in order of logging, times `scale`."""
        with lock:
            data = file.read(MessagePlace(*places[number].tolist()))
        try:
            message: Any = topic.parse(data)
            why = stated_kind(message)
        except _DAMAGE as error:
            if not file.parsed:
                raise RecordingError(
                    f"{file.path} is damaged ({error}); copy it again, or go on with what is whole "
                    "by adding --set recording.accept_truncated=true"
                ) from None
            why = str(error)
        else:
            with suppress(*_DAMAGE):
                depth = decode_message(message, camera, step_mm, scale, unread)
                if depth is not None:
                    return depth
        return (
            f" of {printable(topic.name)} is damaged or not of {camera.width} x {camera.height} "
            f"pixels ({printable(why)})"
        )

    return read


def _plausible(
    read: Callable[[int], Depth | str], n_images: int, factors: Sequence[float]
) -> float:
    """The first factor on depth that suits a camera above an animal.

    The last one if none is plausible, and the first one if all are equal or there are no readings.
    """
    probed = (0, n_images // 2) if len(set(factors)) > 1 else ()
    readings = (one[one > 0] for one in map(read, probed) if not isinstance(one, str))
    median_mm = next((float(np.median(some)) for some in readings if some.size), 0.0)
    good = [f for f in factors if PLAUSIBLE_MM[0] <= f * median_mm <= PLAUSIBLE_MM[1]]
    return [*good, factors[-1 if median_mm else 0]][0]


def open_topic(
    file: MessageFile, kind: str, camera: Lens | None, topic: str | None, progress: Progress
) -> Recording:
    """Open one depth topic of a file of messages as a recording.

    The recording closes the file; it is also closed if opening fails.

    Args:
        file: the open MCAP file or ROS bag.
        kind: name of the format, for `Recording.format`.
        camera: overrides the camera in the files.
        topic: name of the depth topic; None for the only one.
        progress: reports the progress of the walk over the file.

    Returns:
        The recording; reading resumes if the file grows (MCAP).

    Raises:
        RecordingError: there is no depth topic, several to choose from, or the camera is unknown.
    """
    with closing_on_error(file):
        return _open(file, kind, camera, topic, progress, _Found())


def _open(
    file: MessageFile,
    kind: str,
    camera: Lens | None,
    topic: str | None,
    progress: Progress,
    found: _Found,
) -> Recording:
    """`open_topic` with the results of earlier walks."""
    path = file.path
    _walk(file, found, progress)

    def grow() -> Recording | None:
        n_chunks = file.go_on()
        if n_chunks is None:
            return None
        for depth in found.depths.values():
            depth.forget(n_chunks)
        return _open(file, kind, camera, topic, progress, found)

    chosen = _choose(file, found, topic)
    camera_file = CameraFile.read(path.parent / CAMERA_FILE)
    problems: list[str] = [*camera_file.problems, *found.unreadable()]
    doubts: list[str] = []
    if not file.whole:
        problems.append(
            f"{path.name} is cut or damaged; {len(chosen.rows) // 6} whole depth images can be "
            "read from it"
        )
    the_camera = _camera(path, chosen, found, camera_file, camera, file.notes, problems, doubts)
    # A writer may flush its topics out of order; the times of logging define the order.
    rows = np.array(chosen.rows, np.int64).reshape(-1, 6)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    stamps = _stamps(chosen.name, rows, found.stated, problems)
    monotone = in_order_of_sensor(stamps, chosen.order)
    chosen.order = monotone.order
    problems += [monotone.problem] if monotone.problem else []
    packed = PackFacts.of(file.notes)
    problems += packed.problems
    start = start_of_clock(int(monotone.times_ns[0])) or found.stated.start(chosen.name)
    stated = {
        name: file.notes[name]
        for name in ("subject_id", "session_start_time")
        if name in file.notes
    }
    metadata = ({"session_start_time": start} if start else {}) | stated | camera_file.metadata
    stated_mm = found.stated.step_mm(chosen.name, camera_file.states_unit, problems, doubts)
    step_mm = (stated_mm or 1.0) * packed.step_mm
    places = rows[monotone.order, 3:]
    read = _frame_reader(file, chosen, places, the_camera, step_mm, camera_file.unread)
    unit_mm = camera_file.unit_mm
    literal = unit_mm / (1000.0 if chosen.metric else step_mm)
    known = camera_file.states_unit and bool(file.notes or stated_mm)
    factors = [1.0 if known else unit_mm, literal] if camera_file.states_unit else [unit_mm]
    scale = _plausible(read, len(places), factors)
    if known and scale != literal:
        problems.append(
            f"unit_mm = {unit_mm:g} in camera.toml is not used, for the recording states its unit"
        )
    stem = path.resolve().stem
    shape = (the_camera.height, the_camera.width)
    return Recording(
        name=stem.removesuffix(SUFFIX) if packed.packed else stem,
        format=kind,
        camera=the_camera,
        times_ns=monotone.times_ns,
        read=unread_where_damaged(partial(read, scale=scale), shape, problems),
        sources=[path],
        problems=problems,
        truncated=not file.whole,
        metadata=metadata | packed.metadata,
        close=file.close,
        faults=packed.faults(monotone.faults),
        grow=grow,
        doubts=[*packed.doubts, *doubts],
    )


def _stamps(
    topic: str, rows: NDArray[np.int64], stated: Statements, problems: list[str]
) -> NDArray[np.int64]:
    """The sensor's stamps; for all images the times of sending or logging if some have no stamp
    (zero).

    Two clocks are never mixed.
    """
    logged, sent, in_headers = rows[:, :3].T
    stamps = stated.sensor_times(topic, logged, in_headers, problems)
    unstamped = int(((stamps == 0) & (logged != 0)).sum())
    rises = len(stamps) > 1 and np.all(np.diff(stamps) > 0)
    if not unstamped or (unstamped == 1 and rises):  # a clock may begin at zero
        return stamps
    steps, sent_steps = np.diff(logged), np.diff(sent)
    is_even = len(steps) > 1 and sent_steps.min() > 0 and 2.0 * sent_steps.std() < steps.std()
    problems.append(
        f"{unstamped} of {len(stamps)} images have no stamp of the sensor, so the times of "
        f"{'sending' if is_even else 'logging'} are used"
    )
    return sent if is_even else logged


def _walk(file: MessageFile, found: _Found, progress: Progress) -> None:
    """Find the depth topics, the calibrations, and further statements of known programs."""
    parsers = found.parsers

    def wanted(channel: Channel) -> bool:
        if channel not in parsers:
            parsers[channel] = parser_of(channel)
        return parsers[channel] is not None

    def take(message: Envelope | IndexedMessages) -> None:
        parse = parsers[message.channel]
        assert parse is not None
        try:
            if not _note(found, message, parse):
                parsers[message.channel] = None  # ignore its further messages
            found.read.add(message.channel)
        except _DAMAGE as error:
            found.failed.setdefault(message.channel, f"its messages cannot be read: {error}")

    for message in file.walk(wanted, progress):
        take(message)
    for channel, listed in found.listed.items():  # a sample up to the last one
        for k in np.linspace(0, len(listed) - 1, _N_COMPARED).astype(int).tolist():
            log_ns, place = listed[k]
            with suppress(RecordingError):  # reported when a frame in it is read
                take(Envelope(channel, log_ns, place, file.read(place)))
    file.whole = file.whole and not found.failed.keys() & found.read


def _note(found: _Found, envelope: Envelope | IndexedMessages, parse: Parser) -> bool:
    """Record a message; False if its channel is not depth, or if further messages add nothing."""
    channel = envelope.channel
    if isinstance(envelope, IndexedMessages):
        if channel in found.depths:
            found.depths[channel].add_all(envelope)
        elif channel.topic in found.calibrations and len(envelope.places):
            places = map(MessagePlace._make, envelope.places.tolist())
            known_at = found.listed.setdefault(channel, [])
            known_at.extend(zip(envelope.log_time_ns.tolist(), places, strict=True))
        return True
    message = parse(envelope.data)
    if isinstance(message, Statement):
        message = calibration_in(message) or message
    if isinstance(message, Statement):
        return found.stated.add(envelope, message)
    if isinstance(message, Calibration):
        known = found.calibrations.setdefault(channel.topic, [])
        if len(known) < _N_COMPARED and all(message != other for _, other in known):
            known.append((envelope.log_time_ns, message))
        return True
    if channel not in found.depths:
        size = image_size(message)
        if size is None:
            found.kinds[channel] = stated_kind(message)
            return False
        metric = stated_kind(message).startswith(("32FC1", "points"))
        found.depths[channel] = _Topic(channel, parse, message.frame_id, size, metric)
    found.depths[channel].add(envelope, message.stamp_ns)
    return True


def _choose(file: MessageFile, found: _Found, topic: str | None) -> _Topic:
    """The requested topic, or the only one. Images have priority over point clouds derived from
    them.
    """
    depths = list(found.depths.values())
    path = file.path
    names = ", ".join(sorted(printable(depth.name) for depth in depths))
    if topic is not None:
        for depth in depths:
            if depth.name == topic:
                return depth
        offer = f"the depth topics are {names}" if names else "there is no depth topic in it"
        raise RecordingError(f"{path} has no depth images on the topic {topic!r}; {offer}")
    images = [depth for depth in depths if plain_schema(depth.channel) not in CLOUD_SCHEMAS]
    visible = [depth for depth in images if not is_infrared(depth.name)]
    for some in (visible, images, depths):
        if len(some) == 1:
            return some[0]
        if some:
            choice = sorted(printable(depth.name) for depth in some)
            raise RecordingError(
                f"{path} holds depth images on {len(some)} topics, {', '.join(choice)}; choose "
                f"one with --topic {choice[0]} (in Python topic=), or in a plan with "
                "recording.topic"
            )
    raise _no_depth(file, found)


def _no_depth(file: MessageFile, found: _Found) -> RecordingError:
    reasons = {c: f": {printable(why, 200)}" for c, why in (found.failed | found.kinds).items()}
    described = {
        f"{printable(c.topic)} ({printable(c.schema)}, {printable(c.encoding)}){reasons.get(c, '')}"
        for c in file.channels
    }
    listed = ", ".join(sorted(described)[:8]) + (", ..." if len(described) > 8 else "")
    cut = "the file is cut or damaged, and " if not file.whole else ""
    jpeg = any("jp" in kind.lower() for kind in found.kinds.values())
    lossy = "; JPEG does not keep depth, so record the raw or the compressedDepth topic"
    return RecordingError(
        f"{file.path} holds no depth images: {cut}its topics are {listed or 'none'}; {_EXPECTED}"
        + (lossy if jpeg else "")
    )


def _camera(
    path: Path,
    topic: _Topic,
    found: _Found,
    camera_file: CameraFile,
    stated: Lens | None,
    notes: dict[str, str],
    problems: list[str],
    doubts: list[str],
) -> Camera:
    """The camera given by the caller, or else calibrated in the file, or else in a camera.toml."""
    chosen = _calibrations_of(topic, found.calibrations)
    if stated is None and chosen is not None:
        return _calibrated(topic, *chosen, notes, problems, doubts)
    if stated is None and not camera_file.intrinsics:
        raise UnknownCameraError(
            f"{path} {_why_unknown(topic, found)}; write a camera.toml beside it with [camera], fx "
            "= ..., fy = ..., cx = ... and cy = ... in pixels"
        )
    known = (
        (stated.width, stated.height)
        if isinstance(stated, Camera)
        else (camera_file.width, camera_file.height)
    )
    size = _size(topic, (known[0] or 0, known[1] or 0))
    if not min(size):
        raise RecordingError(
            f"{path} holds points that lie in no image on {printable(topic.name)}; write a "
            "camera.toml beside it with [camera], width = ... and height = ... in pixels, to "
            "state the image that shows them"
        )
    return camera_file.camera(*size, stated)


def _why_unknown(topic: _Topic, found: _Found) -> str:
    """Why a file has no calibration for a topic."""
    names = ", ".join(sorted(map(printable, found.calibrations))[:4])
    if not names:
        none = f"holds no CameraCalibration or CameraInfo for {printable(topic.name)}"
        return "; ".join([none, *found.unreadable()])
    usable = any(_is_usable(one) for many in found.calibrations.values() for _, one in many)
    return f"holds calibrations on {names}, " + (
        f"and neither frames nor names show which is that of {printable(topic.name)}"
        if usable
        else "which are empty (uncalibrated: K is zero)"
    )


def _calibrated(
    topic: _Topic,
    where: str,
    calibrations: list[tuple[int, Calibration]],
    notes: dict[str, str],
    problems: list[str],
    doubts: list[str],
) -> Camera:
    """The camera of a topic's calibrations, without distortion for rectified images and points."""
    fits = [one for one in calibrations if _mapped(topic, one[1])[1] == topic.size]
    (first_ns, calibration), *others = fits or calibrations
    kind = "CameraInfo" if topic.channel.encoding in ("ros1", "cdr") else "CameraCalibration"
    here = f"the {kind} on {printable(where)}"
    # a converted file states the original source
    source = notes.get("camera_source", f"{kind} on {where}")
    numbers, size = _mapped(topic, calibration)
    bent = None
    try:
        bent = None if _is_straight(topic) else Distortion.of(calibration.model, calibration.d)
    except LiexError:
        problems.append(
            f"{printable(where)} states a lens distortion ({printable(calibration.model)}) that is "
            "not known and so not undone"
        )
    camera = Camera(*numbers, *size, printable(source), distortion=bent)
    camera = fitting(camera, *_size(topic, size), here)
    if _is_of_another_lens(topic, where, calibration):
        frame = f"frame {calibration.frame_id}" if calibration.frame_id else "by its name"
        doubts.append(
            f"the calibration is that of another lens ({printable(frame)}, on {printable(where)}) "
            f"than the depth on {printable(topic.name)}, so lengths may be wrong: {_STATE_IT}"
        )
    for later_ns, other in others:
        later, _ = _mapped(topic, other)
        scales = (*numbers[:2], *size)
        by = max(abs(a - b) / scale for a, b, scale in zip(later, numbers, scales, strict=True))
        if by > 0.0:
            # of the focal length or the image: a driver's rounding
            (doubts if by > 0.005 else problems).append(
                f"{here} changes {(later_ns - first_ns) * 1e-9:.2f} s after its first: fx, fy, cx, "
                f"cy from {', '.join(f'{n:g}' for n in numbers)} to "
                f"{', '.join(f'{n:g}' for n in later)}; the first is used, and lengths are wrong "
                f"where another one is true: {_STATE_IT}"
            )
            break
    return camera


def _is_straight(topic: _Topic) -> bool:
    """Whether the data have no distortion: rectified images, and points."""
    is_cloud = plain_schema(topic.channel) in CLOUD_SCHEMAS
    return "rect" in topic.name.rpartition("/")[2] or is_cloud


def _mapped(
    topic: _Topic, calibration: Calibration
) -> tuple[tuple[float, float, float, float], tuple[int, int]]:
    """(fx, fy, cx, cy) and size, px, of the images on a topic, by binning and region of interest.

    A calibration describes the full image, of which the topic may show a part or every second
    pixel. Some drivers state binning or region with intrinsics that are mapped already, or with the
    size of the
    part: then the principal point, which is near the centre of most images, decides.
    """
    p = calibration.p
    straight = _is_straight(topic) and len(p) == 12 and p[0] > 0 and p[5] > 0
    k = (*p[0:3], *p[4:7]) if straight else calibration.k
    x, y, width, height = calibration.roi
    across, down = (max(1, n) for n in calibration.binning)
    full = (calibration.width or topic.size[0], calibration.height or topic.size[1])
    part = ((width or full[0]) // across, (height or full[1]) // down)
    plain = (k[0], k[4], k[2], k[5])
    mapped = (
        k[0] / across,
        k[4] / down,
        (k[2] - x + 0.5) / across - 0.5,
        (k[5] - y + 0.5) / down - 0.5,
    )
    wanted = _size(topic, full)
    if wanted not in (full, part):
        return plain, full
    both = [mapped, plain] if part == wanted else [plain, mapped]
    central = [one for one in both if is_central(*one[2:], *wanted)]
    return [*central, *both][0], wanted


def _is_of_another_lens(topic: _Topic, where: str, calibration: Calibration) -> bool:
    """Whether a calibration belongs to another frame than the depth.

    If a frame has no name, the topics decide: /camera/color/camera_info does not belong to
    /camera/depth/image, while /camera/camera_info may.
    """
    frames = {topic.frame_id.strip("/"), calibration.frame_id.strip("/")}
    branch = re.sub(r"(/info)?/[^/]*$", "", f"/{where.strip('/')}")
    return len(frames) > 1 if all(frames) else not topic.name.startswith(f"{branch}/")


def _size(topic: _Topic, of_camera: tuple[int, int]) -> tuple[int, int]:
    """Size of the images; that of the camera for unordered points."""
    return topic.size if min(topic.size) else of_camera


def _calibrations_of(
    topic: _Topic, calibrations: dict[str, list[tuple[int, Calibration]]]
) -> tuple[str, list[tuple[int, Calibration]]] | None:
    """The calibrations of the same camera: of the same frame, or on the topic nearest by name."""
    usable = {
        name: good
        for name, many in calibrations.items()
        if (good := [one for one in many if _is_usable(one[1])])
    }
    firsts = {name: good[0][1] for name, good in usable.items()}
    same_frame = [
        name
        for name, first in firsts.items()
        if topic.frame_id and first.frame_id == topic.frame_id
    ]
    for some in (same_frame, list(usable)):
        near = {name: _n_shared(topic.name, name) for name in some}
        nearest = [name for name in some if near[name] == max(near.values())]
        numbers = {(c.k, c.d, c.width, c.height) for c in map(firsts.get, nearest) if c}
        if len(numbers) == 1 and (len(some) == 1 or near[nearest[0]] > 0):
            return nearest[0], usable[nearest[0]]
    return None


def _is_usable(calibration: Calibration) -> bool:
    """Whether K is valid; K[0] = 0 means "not calibrated" in these messages."""
    k = calibration.k
    return len(k) == 9 and bool(np.isfinite(k).all()) and k[0] > 0 and k[4] > 0


def _n_shared(one: str, other: str) -> int:
    """Number of common leading words of two topics."""
    words = (topic.strip("/").split("/")[:-1] for topic in (one, other))
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(*words, strict=False)))
