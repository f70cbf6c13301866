"""A dashboard that answers on this machine, and what was asked of it."""

import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from flask import Flask
from liex_lab.dashboards.app.data import StudyData
from liex_lab.dashboards.app.server import make_app, serve
from liex_lab.pipelines.bench import Bench
from liex_lab.pipelines.region_config import StatedRegions
from liex_lab.pipelines.study.run import list_sessions

from liex_lab.api import correct_session


def app_of(data: StudyData, place: Path = Path("nowhere"), **more: Any) -> Flask:
    """The dashboard of a study or a folder; reports are not made again."""
    parts = {
        "token": "",
        "alone": True,
        "show_replay": None,
        "correct": partial(correct_session, report=False),
        "report": lambda folder: None,
        "suggest": lambda folder: pd.DataFrame(),
        "reviews": (place if place.is_dir() else place.parent) / "reviews",
        "regions": StatedRegions(place),
        "measuring": None,
    }
    return make_app(data, **(parts | more))


class Served:
    """A dashboard that answers, and how its replay was asked for."""

    def __init__(self, study: Path, **more: Any) -> None:
        self.study, self.began = study, time.monotonic()
        self.asked: list[tuple[Path, float]] = []
        place = study if study.is_dir() else study.parent
        data = StudyData(*list_sessions(study))
        data.warm()
        app = app_of(
            data,
            study,
            show_replay=lambda replay, at_s: self.asked.append((replay, at_s)),
            measuring=Bench(place.resolve()),
            **more,
        )
        ready = threading.Event()

        def told(port: int) -> None:
            self.address = f"http://127.0.0.1:{port}"
            ready.set()

        threading.Thread(target=serve, args=(app, "127.0.0.1", 0, told), daemon=True).start()
        assert ready.wait(20)
