"""`python -m tests.kernels`: makes `pipelines/kernels.json` anew, from a run of each animal.

Every animal is measured once with an empty cache of numba; which kernels were called from Python,
with arguments of which types, and how long each took to compile with all that it calls, is written
down. Kernels that decode a kind of file or render are left out: not every run needs them. It takes
some minutes an animal.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from liex_lab.pipelines.compiling import KERNELS

from liex_lab.catalog import find_sample

SOURCES = {
    "mouse": "",
    "fish": "synthetic:swim?seed=5&frames=120",
    "hand": "synthetic:gesture?seed=5&frames=60",
}
LEFT_OUT = ("liex_lab.recordings.", "liex_lab.simulation.")


def spelling(kind: Any) -> Any:
    """How `kernels.json` spells the numba type of an argument.

    Raises:
        TypeError: it is another kind, such as a function.
    """
    types: Any = import_module("numba.core.types")  # its stubs are incomplete
    if isinstance(kind, types.Array):
        return {"array": [spelling(kind.dtype), kind.ndim, kind.layout, kind.mutable]}
    if isinstance(kind, types.Omitted):
        return {"omitted": kind.value}
    if isinstance(kind, types.NamedTuple | types.NamedUniTuple):
        owner = kind.instance_class
        fields = [spelling(field) for field in kind.types]
        return {"record": f"{owner.__module__}:{owner.__qualname__}", "fields": fields}
    if isinstance(kind, types.BaseTuple):
        return {"tuple": [spelling(field) for field in kind.types]}
    if isinstance(kind, types.Number | types.Boolean | types.NoneType) and not isinstance(
        kind, types.Literal
    ):
        return str(kind)
    raise TypeError(f"an argument of a kernel should be numbers, arrays or records, not {kind}")


def called_kernels(arguments: list[str]) -> list[dict[str, Any]]:
    """The kernels that a command calls from Python, in a process of its own in which all compile.

    Args:
        arguments: of `liex`.
    """
    from numba.core import event

    from liex_lab.cli import main

    rows: list[dict[str, Any]] = []
    began = threading.local()  # one thread may compile while another does

    class Compiles(event.Listener):
        def on_start(self, event: Any) -> None:
            began.stack = [*getattr(began, "stack", ()), time.process_time()]

        def on_end(self, event: Any) -> None:
            spent = time.process_time() - began.stack.pop()
            kernel = event.data["dispatcher"].py_func
            if not began.stack and not kernel.__module__.startswith(LEFT_OUT):
                rows.append(
                    {
                        "kernel": f"{kernel.__module__}:{kernel.__qualname__}",
                        "args": [spelling(kind) for kind in event.data["args"]],
                        "cpu_s": round(spent, 1),
                    }
                )

    with event.install_listener("numba:compile", Compiles()):
        sys.argv = ["liex", *arguments]
        try:
            main()
        except SystemExit as ended:
            if ended.code:
                raise
    return rows


def _recorded(animal: str, folder: Path) -> list[dict[str, Any]]:
    """What the run of an animal calls, with an empty cache and without compiling ahead."""
    recording = str(find_sample("mouse_walk.mcap"))
    if SOURCES[animal]:
        recording = str(folder / f"{animal}.mcap")
        liex = [sys.executable, "-m", "liex_lab"]
        subprocess.run([*liex, "convert", SOURCES[animal], "--to", recording], check=True)
    listed = folder / f"{animal}.json"
    run = ["run", recording, "--plan", animal, "--out", str(folder)]
    cores = str(min(os.sched_getaffinity(0)))  # on one core nothing is compiled ahead
    subprocess.run(
        ["taskset", "-c", cores, sys.executable, "-m", "tests.kernels", str(listed), *run],
        check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder / f"cache-{animal}")},
    )
    return list(json.loads(listed.read_text(encoding="utf-8")))


def main() -> None:
    """Make the list anew, or, given a file and arguments of `liex`, what one command calls."""
    if len(sys.argv) > 1:
        path = Path(sys.argv[1])
        path.write_text(json.dumps(called_kernels(sys.argv[2:])), encoding="utf-8")
        return
    with tempfile.TemporaryDirectory() as folder:
        animals = {animal: _recorded(animal, Path(folder)) for animal in SOURCES}
    lines = [
        f' "{animal}": [\n' + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "\n ]"
        for animal, rows in animals.items()
    ]
    text = '{"schema": 1, "animals": {\n' + ",\n".join(lines) + "\n}}\n"
    KERNELS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
