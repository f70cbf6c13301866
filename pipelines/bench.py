"""The dashboard, and the recordings below its folder: examined and measured one at a time.

Each job is a `liex doctor` or `liex run` in a process of its own; what it prints and its log are
its progress. Paths are relative to the folder and never leave it, and links are refused.
"""

import secrets
import subprocess
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from liex_lab.dashboards.app.data import StudyData
from liex_lab.dashboards.report.report import write_views

from liex_lab.errors import PlaceError, RecordingError, needing
from liex_lab.plan import known_plans
from liex_lab.runtime import durable
from liex_lab.runtime.processes import own_python
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.review import FOLDER
from liex_lab.sessions.viewer import show_replay

from .correct import correct_session
from .region_config import StatedRegions
from .study.run import list_sessions
from .training.action_model import suggest

_RECORDINGS = (".mcap", ".bag", ".db3", ".oni", ".avi", ".mkv", ".gz", ".dat", ".tif", ".tiff")
_MOST = 500  # entries of a folder that are listed
_LINES = 60  # of what a job printed


class Bench:
    """The recordings below a folder, and the job that works on one of them. Thread-safe.

    Attributes:
        place: the folder.
    """

    def __init__(self, place: Path) -> None:
        """Keep the folder; nothing is started."""
        self.place = place
        self._lock = threading.Lock()
        self._job: subprocess.Popen[str] | None = None
        self._lines: list[str] = []
        self._about: dict[str, Any] = {}

    def _inside(self, at: str) -> Path:
        """The path of a text, below the folder."""
        return durable.unlinked_below(self.place, self.place / at)

    def listed(self, at: str) -> dict[str, Any]:
        """What is in a folder below the place.

        Args:
            at: its path in the place; '' is the place.

        Returns:
            at, folders and files (names), plans, and shortened (whether there are more).

        Raises:
            PlaceError: there is no such folder in the place.
        """
        folder = self._inside(at)
        if not folder.is_dir():
            raise PlaceError(f"there is no folder {at or '.'} here; go back to the list")
        entries = sorted(
            entry
            for entry in folder.iterdir()
            if not entry.name.startswith(".") and not entry.is_symlink()
        )
        shown = entries[:_MOST]
        return {
            "at": "" if folder == self.place else folder.relative_to(self.place).as_posix(),
            "folders": [
                one.name for one in shown if one.is_dir() and one.suffix not in (".liex", ".part")
            ],
            "files": [
                one.name for one in shown if one.is_file() and one.suffix.lower() in _RECORDINGS
            ],
            "plans": list(known_plans()),
            "shortened": len(entries) > _MOST,
        }

    def start(self, verb: str, at: str, plan: str) -> None:
        """Examine or measure a recording; its session appears in the place.

        Args:
            verb: 'doctor' or 'run'.
            at: path of the recording in the place.
            plan: a bundled plan; '' finds the one that fits.

        Raises:
            PlaceError: there is no such recording in the place.
            RecordingError: another job is running, or the verb or plan is unknown.
        """
        path = self._inside(at)
        if not path.exists():
            raise PlaceError(f"there is no recording {at} here; go back to the list")
        if verb not in ("doctor", "run") or plan not in ("", *known_plans()):
            raise RecordingError(f"a recording is examined or measured here, got {verb} {plan}")
        words = [verb, str(path), *(["--plan", plan] if plan else [])]
        words += ["--out", str(self.place)] if verb == "run" else []
        with self._lock:
            if self._job is not None and self._job.poll() is None:
                raise RecordingError(
                    f"{self._about['at']} is being worked on; wait for it, or stop it first"
                )
            self._lines = []
            self._about = {"verb": verb, "at": at, "plan": plan}
            log = durable.inside(self.place, path.stem, ".log")
            self._about["log"] = (log, log.stat().st_size if log.is_file() else 0)
            self._job = subprocess.Popen(
                own_python("-m", "liex_lab", *words),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
            threading.Thread(target=self._collect, args=(self._job,), daemon=True).start()

    def _collect(self, job: subprocess.Popen[str]) -> None:
        assert job.stdout is not None
        with job.stdout:
            for line in job.stdout:
                self._lines = [*self._lines, line.rstrip()][-_LINES:]
        job.wait()

    def stop(self) -> None:
        """End the running job as Ctrl-C does; what it measured is kept, and a run resumes."""
        if self._job is not None and self._job.poll() is None:
            self._job.terminate()

    def state(self) -> dict[str, Any]:
        """verb, at, plan, lines (printed), stages (of the log), running and code; {} before any."""
        if self._job is None:
            return {}
        log, start = self._about["log"]
        stages: list[str] = []
        if self._about["verb"] == "run" and log.is_file():
            text = log.read_bytes()[start:].decode("utf-8", "replace")
            stages = [line.partition(" ")[2] for line in text.splitlines()][1:]
        facts = {name: self._about[name] for name in ("verb", "at", "plan")}
        code = self._job.poll()
        return {
            **facts,
            "lines": self._lines,
            "stages": stages[-12:],
            "running": code is None,
            "code": code,
        }


def serve_dashboard(
    study: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8050,
    echo: Callable[[str], None] = print,
    progress: Progress = silent,
) -> None:
    """Serve a study, or a folder that contains sessions, to browsers until interrupted.

    Access requires a token, new for each start, which is part of the address. Replays can be opened
    only if the server listens on this machine alone.

    Args:
        study: a study file, its folder, or a folder that contains sessions.
        host: the network address to listen on; the default is this machine alone.
        port: the port to listen on.
        echo: called with the dashboard's address once it is served.
        progress: receives progress while sessions are loaded.

    Raises:
        MissingPackageError: the extra `dashboard` is not installed.
        StudyError: there is no such study.
    """
    with needing("dashboard", "the dashboard"):
        from liex_lab.dashboards.app.server import LOOPBACK, address, make_app, serve
    place = Path(study) if Path(study).is_dir() else Path(study).parent
    data = StudyData(*list_sessions(study))
    data.warm(progress)
    alone = host in LOOPBACK
    token = secrets.token_urlsafe(24)
    app = make_app(
        data,
        token=token,
        alone=alone,
        show_replay=show_replay if alone else None,
        correct=partial(correct_session, report=False),
        report=write_views,
        suggest=suggest,
        reviews=place / FOLDER,
        regions=StatedRegions(study),
        measuring=Bench(place.resolve()) if alone else None,
    )
    serve(app, host, port, lambda found: echo(address(host, found, token)))
