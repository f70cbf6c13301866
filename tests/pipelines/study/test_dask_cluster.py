"""A cluster tells nobody what it does, and its end is a sentence."""

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from liex_lab.pipelines.study import cluster

from liex_lab.errors import StudyError

_PAGES = ("/", "/json/identity.json", "/info/main/workers.html", "/health", "/metrics", "/status")


@pytest.mark.nightly
def test_its_pages_tell_other_accounts_of_this_machine_nothing() -> None:
    with cluster.crew_of(1) as crew:
        about: dict[str, Any] = crew.client.scheduler_info()
        assert about["address"].startswith("tls://127.0.0.1:")
        ports = [about["services"]["dashboard"]] + [
            worker["services"]["dashboard"] for worker in about["workers"].values()
        ]
        assert len(ports) == 2
        for port in ports:
            for page in _PAGES:
                with pytest.raises(HTTPError) as refused:
                    urlopen(f"http://127.0.0.1:{port}{page}", timeout=20)
                refused.value.close()
                assert refused.value.code == 404


def test_what_is_encrypted_is_known_from_the_address() -> None:
    for address in ("http://x", "tcp://", "x://10.0.0.1:8786"):
        with pytest.raises(StudyError, match="is no address of a Dask scheduler"):
            cluster.is_encrypted(address)
    assert cluster.is_encrypted("tls://10.0.0.1:8786")
    assert not cluster.is_encrypted("tcp://10.0.0.1:8786")
    assert not cluster.is_encrypted("10.0.0.1:8786")


def test_a_scheduler_that_ends_before_the_study_is_a_sentence(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    scheduler = subprocess.Popen(
        [*command, "--port", str(port), "--no-dashboard"], cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    try:
        _until_it_listens(port)
        planned: Any = [SimpleNamespace(session=SimpleNamespace(id=name)) for name in ("a", "b")]
        threading.Timer(2.0, scheduler.kill).start()  # no worker: the sessions wait
        with (
            pytest.raises(StudyError, match="scheduler ended before the study did"),
            cluster.crew_of(2, scheduler=f"tcp://127.0.0.1:{port}") as crew,
        ):
            crew.measure(planned, print)
    finally:
        scheduler.kill()
        scheduler.wait()


def _until_it_listens(port: int) -> None:
    end = time.monotonic() + 60.0
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5.0).close()
        except OSError:
            assert time.monotonic() < end
            time.sleep(0.2)
        else:
            return
