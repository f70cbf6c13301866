"""Live tracking: skeletons of a growing recording, and its smoothed track at the end.

`liex live` learns background, floor and size from the first frames, then measures each frame and
passes it to the online tracker of each animal, which has no lag; frames that have waited are
measured in batches, and none is left out. Which of several animals is which is decided from the
past alone. At the end of the recording the offline tracker computes the whole tracks. Rules trigger
on the rows of the online trackers (`triggers`).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext
from itertools import chain, islice, tee
from pathlib import Path
from typing import Any

import numpy as np
from liex_lab.dashboards.replay.layouts import live_blueprint

from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings import recording, streaming
from liex_lab.recordings.frame import marked
from liex_lab.runtime import durable
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.viewer import LiveView, need_screen
from liex_lab.tracking import curve, identity, observations, track
from liex_lab.tracking.joint import JointTracker
from liex_lab.tracking.tracker import FrameTracker

from .arenas import run_arenas
from .build import build_joint_tracker, build_recording, build_tracker
from .session import check_unused, run_session
from .triggers import Triggers, TriggerWatch


def follow_live(
    source: str,
    plan: Plan,
    *,
    replay: bool = False,
    to: str = "viewer",
    patience_s: float = 3.0,
    triggers: Triggers | None = None,
    out: str | Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Show the skeletons of an ongoing recording in a Rerun viewer; returns measured latencies.

    Args:
        source: a file or folder that is being written, HOST:PORT of a sender, or, with `replay`, a
            recording.
        plan: all settings of the run.
        replay: play back a finished recording at its own pace, as if it were live.
        to: 'viewer' starts a viewer on this machine; 'none' shows nothing; else a viewer's address,
            or an .rrd file.
        patience_s: time without growth after which a file counts as finished, s.
        triggers: rules whose events are sent and logged; None for none.
        out: parent of the sessions, one for each animal, that are made of the recording when it is
            over, and of the log of events; None makes none, and writes the log to the current
            folder.
        progress: receives the number of processed frames.

    Returns:
        Numbers: those of `track_live`; with `out`, `session`: its path, or those of several
            animals; with triggers, `triggers`: what became of the events of each rule and animal,
            and, with a session, their agreement with its own.

    Raises:
        LiexError: the source ends before its first frame, cannot be read, there is no screen for a
            viewer, a rule or receiver cannot be used, or the session cannot be written.
    """
    if to == "viewer":  # fail early, before a wait of minutes
        need_screen("write a file with --to NAME.rrd, which any viewer opens")
    watch = TriggerWatch(triggers, plan) if triggers is not None else None
    if out is not None and not replay and _address(source):
        raise RecordingError(
            f"{source} sends frames and leaves no recording of which a session can be made; follow "
            "the file that is being written, or leave out --out"
        )
    arriving = open_live(source, plan, replay=replay, patience_s=patience_s)
    count = plan.animal.count
    for one in individuals_of(plan, 4 if count == "auto" else count) if out is not None else ():
        name = plan.session.name or arriving.name
        name = name if count == 1 else f"{name}-{one}"
        check_unused(durable.inside(Path(out or "."), name, ".liex"), False)
    if watch is not None:
        watch.write_to(durable.inside(Path(out or "."), arriving.name, ".triggers.jsonl"))
    with nullcontext() if watch is None else closing(watch):
        numbers, _ = track_live(
            arriving,
            plan,
            progress=progress,
            watch=watch,
            viewer=None
            if to == "none"
            else lambda subjects, arriving: LiveView(
                arriving.name,
                arriving.camera,
                subjects[0].T_arena_camera,
                subjects[0].skeleton,
                to,
                live_blueprint(subjects[0].length_mm / 1000.0),
                individuals_of(plan, len(subjects)),
            ),
        )
    if out is not None and count == 1:
        path = run_session(source, plan, out, further=watch, progress=progress)
        numbers["session"] = str(path)
    elif out is not None:
        outcomes = run_arenas(source, plan, out, further=watch, progress=progress)
        numbers["session"] = ", ".join(str(one.session) for one in outcomes)
    if watch is not None:
        numbers |= {"triggers": watch.accounts, "failed_receivers": watch.problems}
    return numbers


def _address(source: str) -> tuple[str, int] | None:
    """Host and port of a sender; None for a file or folder."""
    host, colon, port = source.rpartition(":")
    is_address = colon and port.isdigit() and not Path(source).exists()
    return (host, int(port)) if is_address else None


def open_live(
    source: str, plan: Plan, *, replay: bool = False, patience_s: float = 3.0
) -> streaming.Arriving:
    """Open a live source: a growing file, a network address, or a replayed recording.

    Args:
        source: path of a file or folder that is being written, or HOST:PORT.
        plan: how recordings are opened; one that is cut short is accepted.
        replay: send the recording at `source` at its own pace instead.
        patience_s: a growing file ends when nothing has arrived for so long, s.
    """
    partial = plan.with_settings(["recording.accept_truncated=true"])
    if replay:
        return streaming.replayed(build_recording(source, plan))
    if address := _address(source):
        return streaming.received(*address)
    return streaming.growing(lambda: build_recording(source, partial), patience_s)


def track_live(
    arriving: streaming.Arriving,
    plan: Plan,
    *,
    learn_frames: int = 90,  # to learn the background, the floor and the animal's size from
    viewer: Callable[[Sequence[track.Subject], streaming.Arriving], Any] | None = None,
    watch: TriggerWatch | None = None,
    progress: Progress = silent,
) -> tuple[dict[str, Any], list[track.Tracked]]:
    """Track a recording as its frames arrive; returns latencies and the smoothed tracks.

    Latency is from the arrival of a frame to its skeletons, for all frames since the first one that
    arrived after its predecessors were processed: until then the backlog of learning is processed.

    Args:
        arriving: name, camera and frames as they arrive.
        plan: how the recording is measured, and how many animals.
        learn_frames: frames that background, floor and sizes are learned from.
        viewer: makes a viewer from animals and source, which displays each frame with their rows.
        watch: applies rules to each frame; None for no triggers.
        progress: called frame by frame.

    Returns:
        `name`, `n_frames`, `n_animals`, `n_live`, `latency_median_ms`, `latency_p95_ms` and
        `latency_max_ms` (None without live frames), `n_measured` and `n_bridged` poses,
        `n_crossings` of animals and in how many of them, `n_unclear`, they may have been exchanged;
        and the track of each animal with its head-tail flips.

    Raises:
        RecordingError: the recording ended before its first frame.
        EstimationError: too few animals are found in the frames that are learned from.
    """
    frames = arriving.frames
    held = list(islice(frames, learn_frames))
    if not held:
        raise RecordingError("the recording was over before it had a frame")
    progress(0, None, "learning the background, the floor and the animal's size")
    alone, joint = _learned(arriving, held, plan)
    trackers = joint.trackers if joint else (alone,)
    subjects = [tracker.subject for tracker in trackers]
    identities = identity.OnlineIdentity(subjects)
    online = [curve.OnlineTracker(subject) for subject in subjects]
    view = viewer(subjects, arriving) if viewer else None
    if watch is not None:
        watch.begin(trackers[0], individuals_of(plan, len(trackers)))
    history = list[list[observations.Observations]]()
    latency = list[float]()
    worked_until = time.perf_counter()
    keeping_up = False
    for some in _together(_chained(held, frames)):
        keeping_up = keeping_up or some[0].at_s >= worked_until
        batch = [arrival.frame for arrival in some]
        found = joint.observe(batch) if joint else [alone.observe(batch)]
        for k, arrival in enumerate(some):
            history.append(identities.add([one[k : k + 1] for one in found]))
            rows = [one.add(own) for one, own in zip(online, history[-1], strict=True)]
            unclear = identities.covering | (identities.p_swap > identity.UNCLEAR)
            for part, whose in zip(
                (*rows, *(one.recent[-1:] for one in online)), (*unclear, *unclear), strict=True
            ):
                assert part is not None  # without a lag
                part.flag[(part.flag == "") & whose] = "unclear"
            if watch is not None:
                watch.add(arrival, [one.recent for one in online])
            if view is not None:
                view.show(arrival.frame, rows)
            worked_until = time.perf_counter()
            if keeping_up:
                latency.append(worked_until - arrival.at_s)
            progress(len(history), None, "following")
    if view is not None:
        view.close()
    whole = map(observations.Observations.join, zip(*history, strict=True))
    tracked = [one.track(own) for one, own in zip(trackers, whole, strict=True)]
    quantiles = (np.quantile(latency, [0.5, 0.95, 1.0]) * 1e3).tolist() if latency else [None] * 3
    numbers = {
        "name": arriving.name,
        "n_frames": len(history),
        "n_animals": len(trackers),
        "n_live": len(latency),
        "latency_median_ms": quantiles[0],
        "latency_p95_ms": quantiles[1],
        "latency_max_ms": quantiles[2],
        "n_measured": sum(int(one.track.observed.sum()) for one in tracked),
        "n_bridged": sum(int(one.track.bridged.sum()) for one in tracked),
        "n_crossings": len(identities.crossings),
        "n_unclear": sum(p > identity.UNCLEAR for p in identities.crossings),
    }
    return numbers, tracked


def _learned(
    arriving: streaming.Arriving, held: Sequence[streaming.Arrival], plan: Plan
) -> tuple[FrameTracker, JointTracker | None]:
    """The tracker of one animal, and that of several, from the first frames of a recording."""
    first = recording.Recording(
        name=arriving.name,
        format="live",
        camera=arriving.camera,
        times_ns=np.array([arrival.frame.time_ns for arrival in held], np.int64),
        read=lambda index: held[index].frame.depth,
    )
    alone, count = build_tracker(first, plan), plan.animal.count
    count = alone.scene.n_animals if count == "auto" else count
    return alone, build_joint_tracker(first, plan, alone, count) if count > 1 else None


def individuals_of(plan: Plan, n_animals: int) -> tuple[str, ...]:
    """The names of the animals: that of the plan of a single one, else animal1 and so on."""
    several = tuple(f"animal{k + 1}" for k in range(n_animals))
    return several if n_animals > 1 else (plan.session.individual,)


def _chained(
    held: list[streaming.Arrival], frames: Iterator[streaming.Arrival]
) -> Iterator[streaming.Arrival]:
    """All arrivals, with frames marked that repeat their predecessor."""
    arrivals, again = tee(chain(held, frames))
    for own, arrival in zip(marked(one.frame for one in again), arrivals, strict=True):
        yield arrival._replace(frame=own)


def _together(arrivals: Iterator[streaming.Arrival]) -> Iterator[list[streaming.Arrival]]:
    """Batches of the frames that have arrived, up to 16: in a batch a frame costs half as much."""
    some: list[streaming.Arrival] = []
    for arrival in arrivals:
        some.append(arrival)
        if len(some) == 16 or not arrival.more:
            yield some
            some = []
    if some:
        yield some
