"""Every command and every example of README.md and the manual runs as a reader would run it: page
by page from top to bottom, in a fresh folder, with what earlier pages left there.

A shell runs the commands as they are printed, except for the tables below: what a reader types in
place of a name, what takes too long, and what is not run, with the reason. README.md is followed in
every run of the tests, the manual's pages every night.
"""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

import liex_lab
from liex_lab import cli
from tests.conftest import REPOSITORY

BLOCK = re.compile(r"```(sh|python)\n(.*?)```", re.DOTALL)
PAGES = {
    path.relative_to(REPOSITORY).as_posix(): path.read_text(encoding="utf-8")
    for path in [
        REPOSITORY / "README.md",
        REPOSITORY / "CONTRIBUTING.md",
        *sorted((REPOSITORY / "docs").rglob("*.md")),
    ]
    if not {"auto_examples", "_build"} & set(path.parts)
}
WITH_BLOCKS = [page for page, text in PAGES.items() if BLOCK.search(text)]

# a line that matches is not run, and why
SKIPPED = {
    r"-m pytest|\.ci/\w|pre-commit": "tests, which .ci/run runs",
    r"^\.venv/bin/pip install": "installs packages, which .ci/run does",
    r"^(?:\S*/)?liex show ": "opens a window",
    r"^liex dashboard ": "serves pages until it is stopped",
    r"^liex record ": "needs a camera; pipelines/test_record.py does it without",
    r"^dandi ": "another program, which .ci/peers runs",
    r"^liex evaluate actions --tracks": "needs real mice with people's words",
    r"ANIMAL1|^liex correct crossing ": "needs two animals; sessions/test_identities.py does it",
    r"movement\.kinematics": "another program, which .ci/peers runs",
    r"\"poses_2d\.": "needs PyTables, as DeepLabCut does; exchange/test_peers.py does it",
    r"spikeinterface|recording\.time_to": "another program, which .ci/peers runs",
    r"^liex (?:train|evaluate pose --animal) snake\.toml|--plan plan\.toml": (
        "trains for minutes; training/test_own_animal.py does it"
    ),
}
# what a reader types in place of a printed name, on every page
NAMES = {
    "python3 -m venv .venv && .venv/bin/pip install . && ": "",  # this program is installed
    ".venv/bin/liex": "liex",
    "recording.tar.gz": "recording.mcap",
    "RECORDING": "recording.mcap",
    "SESSION": "mouse_walk.liex",
    "A.liex": "mouse_walk.liex",
    "B.liex": "results/recording.liex",
    "forms/A.boris": "forms/mouse_walk.boris",
    "forms/B.boris": "forms/recording.boris",
    "NAME.": "mouse_walk.",
    "NAME_points/": "mouse_walk_points/",
}
# the page that a reader has followed before; else only the folder of liex_lab is there
AFTER = {
    "docs/howto/boris.md": "README.md",
    "docs/howto/corrections.md": "docs/howto/boris.md",
    "docs/howto/deeplabcut.md": "README.md",
    "docs/howto/ephys.md": "README.md",
    "docs/howto/figures.md": "docs/tutorials/study.md",
    "docs/howto/labels.md": "README.md",
    "docs/howto/movement.md": "README.md",
    "docs/howto/nwb.md": "README.md",
    "docs/howto/points.md": "README.md",
    "docs/howto/skin-points.md": "README.md",
    "docs/howto/spreadsheet.md": "README.md",
    "docs/howto/sync.md": "README.md",
    "docs/reference/exports.md": "docs/tutorials/two-mice.md",
    "docs/reference/session-folder.md": "README.md",
    "docs/tutorials/study.md": "docs/tutorials/mouse.md",
}
# a page with the same commands as another one
SAME = {"docs/start.md": "README.md"}
# what a reader changes on one page: moments of the sample, groups, and how long a recording is
GROUPS = r"""
awk '/^group/ {sub("\"\"", n++ % 2 ? "\"drug\"" : "\"vehicle\"")} 1' study/study.toml > edited
mv edited study/study.toml
"""
EPHYS = """
import datetime, numpy, pynwb
begin = datetime.datetime(2026, 8, 21, tzinfo=datetime.UTC)
made = pynwb.NWBFile(session_description="ephys", identifier="e", session_start_time=begin)
probe = made.create_device("probe")
shank = made.create_electrode_group("shank", description="s", location="CA1", device=probe)
for k in range(4):
    made.add_electrode(group=shank, location="CA1", rel_x=0.0, rel_y=20.0 * k)
every = made.create_electrode_table_region([0, 1, 2, 3], "all")
volts = numpy.random.default_rng(1).normal(0, 10, (20000, 4)).astype("i2")
series = pynwb.ecephys.ElectricalSeries(
    name="ElectricalSeries", data=volts, electrodes=every, starting_time=2.5, rate=1000.0
)
made.add_acquisition(series)
with pynwb.NWBHDF5IO("ephys.nwb", "w") as io:
    io.write(made)
"""
PULSES = f"""
{shlex.quote(sys.executable)} -c {shlex.quote(EPHYS)}
seq 1 0.05 2.6 | awk '{{t = $1 * $1 / 2; print t > "camera.csv"; print t + 9 > "ephys.csv"}}'
"""
CHANGED = {
    "docs/howto/corrections.md": {
        "--from 12.3 --to 14 ": "--from 1.2 --to 1.4 ",
        "--frame 810 --joint nose --to-px 212 148": "--frame 30 --joint nose --to-px 208 54",
        "--at 31.5 --action groom": "--at 4 --action groom",
        "--at 31.5 --from 31.2 --to 33": "--at 4 --from 3.4 --to 4.6",
        "--action rear_supported --from 40 --to 41.5": "--action pause --from 0 --to 0.3",
        "CORRECTED.boris": "forms/mouse_walk.boris",
    },
    "docs/howto/day.md": {
        "liex doctor 'day1": "mkdir day1; cp recording.mcap day1/cam1_0.mcap; liex doctor 'day1"
    },
    "docs/howto/figures.md": {
        "A.liex B.liex": "study/derivatives/liex-lab/sub-m0[12]*/*/behav",
        "--action rear_supported": "--action walk",
    },
    "docs/howto/sync.md": {"liex sync": f"{PULSES}liex sync"},
    "docs/howto/interactions.md": {"several.json": "several.json --frames 300 --recordings 1"},
    "docs/howto/trigger.md": {
        "liex live PAIR": "liex live 'synthetic:pair?seed=3&frames=120' --replay",
        "liex live SOURCE": "liex live 'synthetic:walk?seed=3&frames=40' --replay",
    },
    "docs/tutorials/study.md": {
        "frames=90": "frames=40",
        "liex cohort study/study.toml --dry-run": f"{GROUPS}liex cohort study/study.toml --dry-run",
    },
    "docs/tutorials/fish.md": {
        "frames=120": "frames=20",
        "liex run RECORDING": "liex run 'synthetic:swim?seed=3&frames=20'",
    },
    "docs/tutorials/hand.md": {
        "frames=60": "frames=20",
        "liex run RECORDING": "liex run 'synthetic:gesture?seed=3&frames=20'",
    },
}


def typed(page: str) -> list[tuple[str, str]]:
    """The blocks of a page as a reader types them: language and lines."""
    text = PAGES[page]
    for printed, own in CHANGED.get(page, {}).items():
        assert printed in text, f"{page} does not have {printed!r} any more"
        text = text.replace(printed, own)
    for printed, own in NAMES.items():
        text = text.replace(printed, own)
    blocks = []
    for language, block in BLOCK.findall(text):
        kept = [line for line in block.splitlines() if not skipped(line)]
        blocks.append((language, "\n".join(kept)))
    return blocks


@pytest.fixture(scope="module")
def follow(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Follow a page, once, after the pages before it; the folder that it leaves."""

    @cache
    def follow(page: str) -> Path:
        if page in SAME:
            assert set(typed(page)) <= set(typed(SAME[page])), "the pages differ: follow both"
            return follow(SAME[page])
        folder = tmp_path_factory.mktemp("reader")
        if page in AFTER:
            shutil.copytree(follow(AFTER[page]), folder, symlinks=True, dirs_exist_ok=True)
        else:
            (folder / "datasets").symlink_to(REPOSITORY / "datasets")
            run_shell("liex convert 'synthetic:walk?seed=3&frames=60' --to recording.mcap", folder)
        for language, block in typed(page):
            {"sh": run_shell, "python": run_python}[language](block, folder)
        return folder

    return follow


def skipped(line: str) -> bool:
    return any(re.search(pattern, line) for pattern in SKIPPED)


def run_shell(block: str, folder: Path) -> None:
    """Let a shell run a block; its calls of `liex` come back to this process, which is quicker."""
    calls, call = os.pipe()
    codes, code = os.pipe()
    begin = f"""set -eu
    liex() {{ printf '%q ' "$@" >&{call}; echo >&{call}; read -r code <&{codes}; return $code; }}
    """
    command = ["bash", "-c", begin + block]
    shell = subprocess.Popen(command, cwd=folder, pass_fds=(call, codes), text=True)
    os.close(call)
    os.close(codes)
    printed = ""
    with chdir(folder), open(calls) as asked, open(code, "w") as answer:
        for line in asked:
            result = CliRunner().invoke(cli.app, shlex.split(line))
            printed = f"liex {line}{result.output}{result.exception}"
            print(result.exit_code, file=answer, flush=True)
    assert shell.wait() == 0, printed


def run_python(block: str, folder: Path) -> None:
    """Run an example; what it asks of liex_lab itself is public."""
    with chdir(folder):
        exec(compile(block, "example", "exec"), {})
    names = {
        node.attr
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "liex_lab"
    }
    assert names <= set(liex_lab.__all__)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=() if page == "README.md" else pytest.mark.nightly)
        for page in WITH_BLOCKS
    ],
)
def test_a_page_can_be_followed_as_it_is_printed(page: str, follow: Callable[[str], Path]) -> None:
    follow(page)


@pytest.mark.parametrize("page", PAGES)
def test_a_block_says_whether_it_is_to_be_run(page: str) -> None:
    fences = re.findall(r"^ *```(.*)$", PAGES[page], re.MULTILINE)
    assert set(fences[::2]) <= {"sh", "python", "toml", "text"}
    assert set(fences[1::2]) <= {""}
