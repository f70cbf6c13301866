"""A run and a look that take no time: they give what the study looks at, or break in the way the
recording's name asks for.
"""

import errno
import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from liex_lab.errors import EstimationError, RecordingError
from liex_lab.plan import Plan
from liex_lab.plan.study import PlannedSession
from liex_lab.runtime.progress import Progress
from liex_lab.sessions.provenance import SCHEMA_VERSION, versions

N_FRAMES = 40


def pretended_run(
    recording: str,
    plan: Plan,
    *,
    folder: Path,
    overwrite: bool,
    notes: dict[str, Any],
    pool: object,
    progress: Progress,
) -> Path:
    """Stands in for `run_session`."""
    from liex_lab.catalog import find_model, sha256
    from liex_lab.recordings.recording import file_digest

    name = Path(recording).stem
    marks = Path(recording).parents[1] / f"{name}.runs"
    with marks.open("a") as file:
        file.write("x")
    progress(0, None, "learning the background")
    if name.startswith("empty"):
        raise EstimationError(
            "no animal was found in the sampled frames; check the depth unit and the plan"
        )
    for done in (16, 32, N_FRAMES):
        progress(done, N_FRAMES, "measuring poses")
        if name.startswith("torn") and done == 32:
            raise RecordingError("frame 33 cannot be read; copy the recording again")
        if name.startswith("full") and done == 32:
            raise OSError(errno.ENOSPC, "No space left on device", "/data/x")
        if name.startswith("fault") and done == 16:
            raise ZeroDivisionError("a slip of ours")
        if name.startswith("deadly") or (name.startswith("unlucky") and marks.stat().st_size == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if name.startswith("slow"):
            time.sleep(30)
    (folder / "failed.json").unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        "schema_version": SCHEMA_VERSION,
        "session_id": plan.session.name,
        "versions": versions(),
        "plan": plan.model_dump(exclude_none=True),
        "model": {"sha256": sha256(find_model(plan.estimation.model))},
        "input": {"sha256": file_digest([Path(recording)]), **notes["input"]},
        "run_id": notes["run_id"],
        "problems": notes.get("problems", []),
        "frames": {"n_frames": N_FRAMES, "n_observed": 39, "observed_s": 1.3},
        "frames_per_s": 100.0,
        "peak_memory_mb": 500.0,
        "threads": os.environ.get("NUMBA_NUM_THREADS"),
        "shared": pool is not None,
    }
    (folder / "session.json").write_text(json.dumps(document))
    return folder


def pretended_inspection(session: PlannedSession, progress: Progress) -> dict[str, Any]:
    """Stands in for `status.inspect_animal`: the recording holds the animal's length, mm."""
    from liex_lab.pipelines.study.status import about

    from liex_lab.catalog import find_model, sha256

    path = Path(session.recording)
    with (path.parents[1] / f"{path.stem}.looks").open("a") as file:
        file.write("x")
    progress(0, None, "inspecting the animal")
    if path.stem.startswith("deadly"):
        os.kill(os.getpid(), signal.SIGKILL)
    if path.stem.startswith("empty"):
        failure = {"reason": "no animal was found in the sampled frames", "stage": "looking"}
        return about(session) | {"failure": failure}
    model = {"sha256": sha256(find_model(session.plan.estimation.model))}
    animal = {"spine_mm": float(path.read_text()), "girth": 1.1}
    misfits = ["its body covers 3% of the outline that is seen"] * path.stem.startswith("other")
    return about(session) | {
        "model": model,
        "animal": animal,
        "log_sd": 0.02,
        "n_frames": 40,
        "stated": session.plan.animal.spine_mm is not None,
        "misfits": misfits,
    }


def shared_task(n: int) -> list[tuple[int, int]]:
    """A session's task that shares its stretches: each one's number, and the process that
    did it.
    """
    from liex_lab.pipelines.study.crew import Workers

    return list(Workers().each(stretch, range(n)))


def stretch(number: int) -> tuple[int, int]:
    """Stands in for `measure_shard`."""
    time.sleep(0.2)
    return number, os.getpid()
