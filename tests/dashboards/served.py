"""A dashboard that answers on this machine, and what was asked of it."""

import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

from liex_lab.dashboards.app.data import StudyData
from liex_lab.dashboards.app.server import make_app, serve
from liex_lab.pipelines.bench import Bench
from liex_lab.pipelines.region_config import StatedRegions
from liex_lab.pipelines.study.run import list_sessions

from liex_lab.api import correct_session


class Served:
    """A dashboard that answers, and how its replay was asked for."""

    def __init__(self, study: Path, **more: Any) -> None:
        self.study, self.began = study, time.monotonic()
        self.asked: list[tuple[Path, float]] = []
        place = study if study.is_dir() else study.parent
        data = StudyData(*list_sessions(study))
        data.warm()
        app = make_app(
            data,
            show_replay=lambda replay, at_s: self.asked.append((replay, at_s)),
            correct=partial(correct_session, report=False),
            reviews=place / "reviews",
            regions=StatedRegions(study),
            measuring=Bench(place.resolve()),
            **more,
        )
        ready = threading.Event()

        def told(port: int) -> None:
            self.address = f"http://127.0.0.1:{port}"
            ready.set()

        threading.Thread(target=serve, args=(app, "127.0.0.1", 0, told), daemon=True).start()
        assert ready.wait(20)
