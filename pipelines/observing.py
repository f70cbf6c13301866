"""What single frames of a recording say, two stretches of frames at once.

A kernel that is shared out over the cores waits for its slowest part, and that part shares its core
with reading and packing. So two stretches are looked at side by side, each on half of the threads:
what a frame says does not depend on others, and the stretches are told in their order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from liex_lab.runtime.threads import serial_products

if TYPE_CHECKING:
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.tracker import FrameTracker

_AT_ONCE = 2
Observed = tuple["list[DepthFrame]", "Observations"]


def observed(
    tracker: FrameTracker, stretches: Iterable[list[DepthFrame]]
) -> Generator[Observed, None, None]:
    """Stretches of frames with what single frames say, in their order.

    Args:
        tracker: prepared for their recording.
        stretches: consecutive frames; so many are taken ahead as are looked at at once.

    Yields:
        Each stretch with its observations; what goes wrong with one is raised in its turn.
    """
    import numba

    n_threads = numba.get_num_threads()
    if n_threads < _AT_ONCE or not _may_share():
        for frames in stretches:
            yield frames, tracker.observe(frames)
        return
    waiting: deque[tuple[list[DepthFrame], Future[Observations]]] = deque()
    # products are serial all the while: the limit is one of the process, not of a thread
    with (
        serial_products(),
        ThreadPoolExecutor(
            _AT_ONCE, initializer=numba.set_num_threads, initargs=(n_threads // _AT_ONCE,)
        ) as pool,
    ):
        try:
            for frames in stretches:
                waiting.append((frames, pool.submit(tracker.observe, frames)))
                if len(waiting) > _AT_ONCE:
                    yield _first(waiting)
            while waiting:
                yield _first(waiting)
        finally:
            for _, coming in waiting:
                coming.cancel()


def _first(waiting: deque[tuple[list[DepthFrame], Future[Observations]]]) -> Observed:
    """The stretch that was taken first, once it has been looked at."""
    frames, coming = waiting.popleft()
    return frames, coming.result()


def _may_share() -> bool:
    """Whether several threads may run parallel kernels at once: numba's own layer ends a process
    in which they do. False where none has been run yet.
    """
    import numba

    try:
        return numba.threading_layer() in ("omp", "tbb")
    except ValueError:
        return False
