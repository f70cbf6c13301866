"""Entities of a Rerun replay: depth images, camera, arena, zones, fixtures, and the animal's body.

Depth is stored without loss: RVL (Wilson 2017, run-length and variable-length coding), or PNG if
sensor noise makes that smaller. A cut-out belongs to its own pinhole camera, whose principal point
is that of the camera minus the corner (left, top) of its window (see `cutouts.windows`):

    K' = K - [[0, 0, left], [0, 0, top], [0, 0, 0]].

The still scene is stored once. The entities below `PLACES` position every cut-out in the image, see
`cutout_frame`.

Rerun 0.41 treats the images of an entity over time as a video (rerun-io/rerun#12801). It reports no
problem if all images of an entity have one size and one encoding, and the encoding is logged once
for all times. So every window size and every encoding has its own entity, and only one of each
group shows an image at a time. Without a time only PNG is accepted.

The scene is static. Every triangle of the body follows one joint, so a frame costs a few rigid
transforms instead of a mesh: the trunk at home pose is cut at its joints, and each vertex belongs
to its nearest bone.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Final

import cv2
import numpy as np
import rerun as rr

from liex_lab.actions import vocabulary
from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.session_shape import built
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.depth_kernels import rvl_message
from liex_lab.scene.scene import Scene
from liex_lab.sessions.cutouts import N_WINDOWS, Boxes, window_around, windows
from liex_lab.sessions.provenance import Provenance
from liex_lab.tables.rows import Rows
from liex_lab.tracking.track import Track

IMAGE = "arena/camera/image"
DEPTH = f"{IMAGE}/depth"
NOISY = f"{DEPTH}/png"  # whole images whose noise makes PNG smaller
BACKGROUND = f"{IMAGE}/background"
PLACES = f"{IMAGE}/places"
CUTOUTS = "arena/camera/cutouts"
MM_PER_UNIT = 1000.0  # our depth is in mm, the scene in metres
# media types
_RVL = "application/rvl"
_PNG = "image/png"
# OpenCV's IMWRITE_PNG_COMPRESSION 1 and IMWRITE_PNG_STRATEGY 2, HUFFMAN_ONLY
_NOISY_PNG = (16, 1, 17, 2)
# images, and their bytes, per message: the index at the file's end needs some 5 kB of memory
# per message
_TOGETHER = 128
_TOGETHER_BYTES = 1 << 23


class DepthColumns:
    """Depth images to be written together.

    Args:
        origin: camera, its distance from the floor, and the still scene.
    """

    def __init__(self, origin: Provenance) -> None:
        self._origin = origin
        self._windows = windows(origin)
        self._waiting: list[_KeptImage] = []
        self._n_bytes = 0
        self._introduced: set[str] = set()
        self._shown: set[str] = set()  # entities that show an image of earlier frames
        self._resumed = False

    def resume(self) -> None:
        """Continue another file, whose last visible entities are unknown."""
        self._resumed = True

    def take(
        self,
        frame_index: int,
        elapsed_ns: int,
        depth: NDArray[np.uint16],
        boxes: Boxes | None,
    ) -> bool:
        """Add the next image.

        Args:
            frame_index: the camera's count of the frame.
            elapsed_ns: time since the first frame, ns.
            depth: (H, W) uint16 mm, 0 where unread; the still scene outside of its cut-outs.
            boxes: (K, 4) left, top, right and bottom of its cut-outs, px, all 0 if absent; None for
                a whole image.

        Returns:
            Whether to `send` the waiting images.
        """
        parts: dict[str, NDArray[np.uint8]] = {}
        places: list[tuple[int, int, int, int]] = []
        if boxes is None:
            blob, media_type = packed(depth)
            parts[DEPTH if media_type == _RVL else NOISY] = blob
        for k, box in enumerate(() if boxes is None else boxes.tolist()):
            places.append((0, 0, 0, 0))
            if box[2] > box[0]:
                # always RVL: it is several times as fast as PNG, and not larger
                which, places[k] = window_around(box, self._windows)
                left, top, right, bottom = places[k]
                parts[cutout_entity(k, which)] = rvl_message(depth[top:bottom, left:right])
        self._waiting.append(_KeptImage(int(frame_index), elapsed_ns, parts, places))
        self._n_bytes += sum(len(blob) for blob in parts.values())
        return len(self._waiting) == _TOGETHER or self._n_bytes > _TOGETHER_BYTES

    def send(self, stream: Any) -> int:
        """Write the waiting images.

        Args:
            stream: the Rerun stream.

        Returns:
            Number of messages with images.
        """
        waiting = self._waiting
        self._waiting = []
        self._n_bytes = 0
        if not waiting:
            return 0
        n_cutouts = len(waiting[0].windows)
        for k in range(n_cutouts):
            self._send_lens(stream, k, waiting)
        if self._resumed:
            self._resumed = False
            cutouts = (cutout_entity(k, n) for k in range(n_cutouts) for n in range(N_WINDOWS))
            cut_out = self._origin.background is not None
            self._shown = set(cutouts if cut_out else (DEPTH, NOISY))
        entities = sorted(self._shown.union(*(image.parts for image in waiting)))
        for entity in entities:
            # its images, and the frame from which it shows none
            blobs = [image.parts.get(entity) for image in waiting]
            shows = np.array([blob is not None for blob in blobs])
            rows = np.flatnonzero(shows | np.append(entity in self._shown, shows[:-1]))
            if shows.any() and entity.startswith(CUTOUTS) and entity not in self._introduced:
                assert self._origin.background is not None
                style = self._style(self._origin.background)
                kind = rr.EncodedDepthImage.from_fields(**style, media_type=_RVL, draw_order=-30.0)
                stream.log(entity, kind, static=True)
                self._introduced.add(entity)
            columns = rr.EncodedDepthImage.columns(
                blob=[blob for blob in blobs if blob is not None]
            )
            partition = columns.partition(shows[rows].astype(int))
            stream.send_columns(entity, _when([waiting[row] for row in rows]), [*partition])
        self._shown = set(waiting[-1].parts)
        return len(entities)

    def _send_lens(self, stream: Any, k: int, waiting: "Sequence[_KeptImage]") -> None:
        """Send the intrinsics of the k-th cut-out of frames, and its position in the image."""
        boxes = np.array([image.windows[k] for image in waiting], np.float64)
        if not (boxes[:, 2] > boxes[:, 0]).any() and k:
            return
        n = len(boxes)
        lens = np.tile(self._origin.camera.matrix, (n, 1, 1))
        lens[:, :2, 2] -= boxes[:, :2]
        lenses = rr.Pinhole.columns(
            image_from_camera=lens,
            resolution=np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0),
        )
        places = rr.Transform3D.columns(
            translation=np.hstack([boxes[:, :2], np.zeros((n, 1))]),
            child_frame=[cutout_frame(k)] * n,
            parent_frame=[f"tf#/{IMAGE}"] * n,
        )
        when = _when(waiting)
        stream.send_columns(f"{CUTOUTS}/{k + 1}", when, [*lenses])
        stream.send_columns(f"{PLACES}/{k + 1}", when, [*places])

    def log_kind(self, stream: Any, first: NDArray[np.uint16], *, whole: bool) -> None:
        """Log the static properties of whole images (encoding, unit, colours, layout), or the still
        scene.

        Args:
            stream: the Rerun stream.
            first: (H, W) uint16 mm, the first image.
            whole: whole images are kept, no cut-outs.
        """
        if whole:
            for entity, media_type in ((DEPTH, _RVL), (NOISY, _PNG)):
                kind = rr.EncodedDepthImage.from_fields(
                    **self._style(first),
                    media_type=media_type,
                    draw_order=-20.0,
                )
                stream.log(entity, kind, static=True)
            return

        assert self._origin.background is not None
        scene = rr.EncodedDepthImage(
            blob=cv2.imencode(".png", self._origin.background)[1].ravel(),
            media_type=_PNG,
            **self._style(self._origin.background),
            draw_order=-40.0,
        )
        stream.log(BACKGROUND, scene, static=True)

    def _style(self, depth: NDArray[np.uint16]) -> dict[str, Any]:
        """Unit and colours of images similar to this one."""
        return {
            "meter": MM_PER_UNIT,
            "colormap": "viridis",
            "point_fill_ratio": 0.25,
            "depth_range": colour_range(depth, self._origin.floor_distance_mm),
        }


@dataclass(frozen=True)
class _KeptImage:
    """Kept depth of a frame: its packed parts by entity, and the windows of its cut-outs
    (left, top, right, bottom, px; all 0 if absent), empty for a whole image.
    """

    index: int
    elapsed_ns: int
    parts: dict[str, NDArray[np.uint8]]
    windows: Sequence[tuple[int, int, int, int]]


def _when(images: Sequence[_KeptImage]) -> list[rr.TimeColumn]:
    """The timelines of images."""
    return timeline(
        np.array([image.index for image in images], np.int64),
        np.array([image.elapsed_ns for image in images], np.int64),
    )


def cutout_entity(k: int, which: int) -> str:
    """Entity of the k-th cut-out in a window.

    Replays of earlier versions use that of the smallest window for every cut-out.

    Args:
        k: counted from 0.
        which: of the `windows`, counted from 0.
    """
    entity = f"{CUTOUTS}/{k + 1}/depth"
    return f"{entity}/{which + 1}" if which else entity


def cutout_frame(k: int) -> str:
    """Rerun's name of the coordinate frame of the k-th cut-out in the image.

    In space a cut-out has its own pinhole camera; in a view of the image its entity is placed into
    this frame instead, because Rerun does not show one camera's image in another's.

    Args:
        k: counted from 0.
    """
    return f"cutout {k + 1} in the picture"


def packed(depth: NDArray[np.uint16]) -> tuple[NDArray[np.uint8], str]:
    """Encode a depth image without loss.

    RVL is fast and halves the size of raw images. If noise makes it large, beyond 0.54 bytes per
    pixel, PNG is used if smaller (Huffman coding only: noise has no runs).

    Args:
        depth: (H, W) uint16 mm, 0 where unread.

    Returns:
        The bytes, and their media type: 'application/rvl' or 'image/png'.
    """
    rvl = rvl_message(depth)
    # bytes per pixel: 166 kB for 640 x 480
    if len(rvl) > 0.54 * depth.size:
        png = cv2.imencode(".png", depth, _NOISY_PNG)[1].ravel()
        # by Rerun's own compression: RVL by this factor, PNG not at all
        if len(png) < 0.93 * len(rvl):
            return png, _PNG
    return rvl, _RVL


def colour_range(depth: NDArray[np.uint16], floor_distance_mm: float) -> tuple[float, float]:
    """Depth range of the colour map: the floor of the first frame, and 80 mm above.

    A floor tilted by 10 degrees is covered, but not the walls.

    Args:
        depth: (H, W) uint16 mm of the first frame, 0 where unread.
        floor_distance_mm: distance of the camera from the floor, mm.

    Returns:
        (near, far), mm.
    """
    read = depth[depth > 0]
    near, far = (
        np.percentile(read, [2.0, 98.0]) if len(read) else (floor_distance_mm, floor_distance_mm)
    )
    # a floor tilted by 10 degrees, but not the walls
    near = max(float(near), floor_distance_mm - 60.0) - 80.0
    return max(near, 1.0), max(float(far), near + 10.0) + 10.0


def timeline(index: NDArray[np.int64], elapsed_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The timelines `frame` and `time` of n rows.

    Args:
        index: (n,) the camera's count of the frames.
        elapsed_ns: (n,) time since the first frame, ns.
    """
    return [
        rr.TimeColumn("frame", sequence=index),
        rr.TimeColumn("time", duration=elapsed_ns.astype("timedelta64[ns]")),
    ]


OVERLAY: Final = f"{IMAGE}/overlay"
FLOOR: Final = "arena/floor"
BODY: Final = "arena/body"
PALETTE = tuple(int(colour[1:], 16) for colour in vocabulary.PALETTE)
_GREY: Final = [154, 160, 166, 255]
_PURPLE: Final = [170, 51, 119, 255]


def rgba(colours: Iterable[int]) -> NDArray[np.uint32]:
    """0xRRGGBB as uint32 colours, which Rerun cannot confuse with a list of channels."""
    return np.array([colour << 8 | 0xFF for colour in colours], np.uint32)


def log_camera(stream: Any, camera: Camera, T_arena_camera: SE3) -> None:
    """Log the arena's axes, the camera's pose in it and its intrinsics."""
    pose = rr.Transform3D(
        translation=T_arena_camera.translation / MM_PER_UNIT, mat3x3=T_arena_camera.rotation
    )
    lens = rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.05,
    )
    stream.log("arena", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("arena/camera", pose, static=True)
    stream.log(IMAGE, lens, static=True)


def log_outlines(stream: Any, origin: Provenance) -> None:
    """Log walls and zones, on the floor and over the depth image."""
    walls = origin.arena.outline_mm()
    drawn = [("walls", "", walls, 0x9AA0A6)] if len(walls) else []
    for zone, colour in zip(origin.zones, cycle(PALETTE), strict=False):
        part = f"zones/{rr.escape_entity_path_part(zone.name)}"
        drawn.append((part, zone.name, zone.outline_mm(), colour))
    for part, name, outline, colour in drawn:
        ring = np.column_stack([outline, np.zeros(len(outline))])[[*range(len(outline)), 0]]
        style: dict[str, Any] = {"colors": rgba([colour]), "labels": [name] if name else None}
        on_floor = rr.LineStrips3D([ring / MM_PER_UNIT], radii=0.001, **style)
        stream.log(f"{FLOOR}/{part}", on_floor, static=True)
        uv_px = origin.camera.project(origin.T_arena_camera.inverse() @ ring) + 0.5
        if np.isfinite(uv_px).all():
            in_image = rr.LineStrips2D([uv_px], radii=rr.Radius.ui_points(1.0), **style)
            stream.log(f"{OVERLAY}/{part}", in_image, static=True)


def log_surroundings(stream: Any, scene: Scene) -> None:
    """Log the region, outside of which nothing is measured, and the fixtures on the floor."""
    if scene.region_px:
        ring = np.array([*scene.region_px, scene.region_px[0]]) + 0.5
        outline = rr.LineStrips2D(
            [ring], radii=rr.Radius.ui_points(1.0), colors=[_GREY], labels=["region"]
        )
        stream.log(f"{OVERLAY}/region", outline, static=True)
    if scene.fixtures:
        tops = np.array([[*one.centre_mm, one.height_mm] for one in scene.fixtures])
        labels = [f"fixture, {one}" for one in scene.fixtures]
        points = rr.Points3D(tops / MM_PER_UNIT, radii=0.003, colors=[_GREY], labels=labels)
        stream.log(f"{FLOOR}/fixtures", points, static=True)


def log_hidden_places(stream: Any, rows: Rows) -> None:
    """Log the last position of the animal before each time it was hidden, with the times."""
    gaps = rows.gaps()
    hidden = (gaps["reason"] == "hidden") & np.isfinite(gaps["x_mm"])
    if not hidden.any():
        return
    x, y, start, stop = (gaps[name][hidden] for name in ("x_mm", "y_mm", "start_s", "stop_s"))
    labels = [f"hidden {a:.1f} to {b:.1f} s" for a, b in zip(start, stop, strict=True)]
    places = np.column_stack([x, y, np.zeros(len(x))]) / MM_PER_UNIT
    points = rr.Points3D(places, radii=0.004, colors=[_PURPLE], labels=labels)
    stream.log(f"{FLOOR}/hidden", points, static=True)


@dataclass(frozen=True)
class BodyPart:
    """A piece of the surface, in the frame of its joint.

    Attributes:
        joint: the joint's index.
        vertices: (V, 3) mm at scale 1.
        faces: (F, 3) vertex indices.
        normals: (V, 3) unit vectors.
    """

    joint: int
    vertices: Array
    faces: NDArray[np.int64]
    normals: Array


def body_of(skeleton: Skeleton, animal: Mapping[str, Any]) -> tuple[Surface, float]:
    """The session's body: the fitted shape if kept, or the average one at its best girth.

    Args:
        skeleton: the skeleton, which has a surface.
        animal: section `animal` of session.json.

    Returns:
        The surface, and the girth relative to the usual one for its length.
    """
    shape = animal.get("shape") or {}
    average = Surface.of(skeleton)
    girth = float(animal.get("girth", 1.0))
    if not shape.get("kept") or not isinstance(average.body, BodyShape):
        return average, girth
    return built(skeleton, shape["width"], shape["height"], shape["places"]), girth


def body_parts(surface: Surface, girth: float = 1.0) -> list[BodyPart]:
    """Trunk of an animal at home pose, cut at its joints.

    Each part is extended by one ring of faces, so that a bent body shows no gap.

    Args:
        surface: of the animal.
        girth: of the animal, relative to the usual one for its length.

    Returns:
        One part per joint that carries any face.
    """
    skeleton = surface.skeleton
    home = Pose.home(skeleton)
    faces = surface.faces[: surface.n_trunk_faces].astype(np.int64)
    vertices = surface.vertices(home, girth=girth, parallel=False)
    frames = home.frames(skeleton)
    normals = _normals(vertices, faces)
    carrier = _carriers(skeleton, vertices)
    parts = []
    for joint in np.unique(carrier[faces]).tolist():
        own = faces[(carrier[faces] == joint).any(axis=1)]
        used, renumbered = np.unique(own, return_inverse=True)
        into = SE3(frames.rotation[joint], frames.translation[joint]).inverse()
        parts.append(
            BodyPart(
                int(joint),
                into @ vertices[used],
                renumbered.reshape(own.shape),
                normals[used] @ into.rotation.T,
            )
        )
    return parts


def _carriers(skeleton: Skeleton, vertices: Array) -> NDArray[np.int64]:
    """(V,) for each vertex the parent joint of the nearest bone at home pose."""
    home = Pose.home(skeleton).joints(skeleton)
    parents, children = np.array(skeleton.edges, np.int64).T
    along = home[children] - home[parents]
    out = vertices[:, None] - home[parents]
    share = (out * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12)
    off = np.linalg.norm(out - np.clip(share, 0.0, 1.0)[..., None] * along, axis=-1)
    return np.asarray(parents[off.argmin(axis=1)])


def _normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """(V, 3) unit normals: the mean of the faces around each vertex, weighted by their areas."""
    corners = vertices[faces]
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros(vertices.shape)
    np.add.at(out, faces.ravel(), np.repeat(of_faces, 3, axis=0))
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def log_body(stream: Any, skeleton: Skeleton, animal: Mapping[str, Any]) -> list[int]:
    """Log the body's parts once; returns the joints that carry one.

    Args:
        stream: the Rerun stream.
        skeleton: the skeleton, which has a surface.
        animal: section `animal` of session.json, see `body_of`.
    """
    parts = body_parts(*body_of(skeleton, animal))
    for part in parts:
        mesh = rr.Mesh3D(
            vertex_positions=part.vertices / 1000.0,
            triangle_indices=part.faces,
            vertex_normals=part.normals,
            albedo_factor=[176, 190, 205, 150],
        )
        stream.log(_body_entity(skeleton, part.joint), mesh, static=True)
    return [part.joint for part in parts]


def body_columns(track: Track, carriers: list[int]) -> Iterator[tuple[str, Any]]:
    """Entity and columns of each part of the body in some frames; its scale is 0 without a pose.

    Args:
        track: the frames.
        carriers: the joints that carry a part, from `log_body`.
    """
    posed = track.posed
    frames = Pose(track.root, track.angles_rad, track.scale)[posed].frames(track.skeleton)
    size = np.where(posed, np.nan_to_num(track.scale), 0.0)
    for joint in carriers:
        place = np.zeros((len(posed), 3))
        xyzw = np.tile([0.0, 0.0, 0.0, 1.0], (len(posed), 1))
        place[posed] = frames.translation[:, joint] / MM_PER_UNIT
        xyzw[posed] = np.roll(so3.quaternion(frames.rotation[:, joint]), -1, axis=-1)
        columns = rr.Transform3D.columns(
            translation=place, quaternion=xyzw, scale=np.repeat(size[:, None], 3, axis=1)
        )
        yield _body_entity(track.skeleton, joint), columns


def _body_entity(skeleton: Skeleton, joint: int) -> str:
    return f"{BODY}/{rr.escape_entity_path_part(skeleton.names[joint])}"


# Size of a skeleton in replays, so that no animal vanishes behind its own joints.


_MOST_MM = 3.0
_OF_BONE = 0.3
_MOST_PT = 3.5


def dot_mm(skeleton: Skeleton) -> float:
    """Radius of a joint in space, mm: 0.3 of the median bone of the skeleton, at most 3."""
    return float(min(_MOST_MM, _OF_BONE * np.median(np.linalg.norm(skeleton.offsets[1:], axis=1))))


def dot_pt(skeleton: Skeleton) -> float:
    """Radius of a joint over an image, in screen points: at most 3.5, at least 1.5."""
    return max(1.5, _MOST_PT * float(np.sqrt(dot_mm(skeleton) / _MOST_MM)))
