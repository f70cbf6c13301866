"""The command line: quick to ask, one sentence and exit code 1 for what the user can put right,
JSON that is JSON.
"""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from liex_lab.dashboards.paper.published import DEVIATIONS
from typer.testing import CliRunner

import liex_lab
from liex_lab import api, cli
from liex_lab.cli.options import tell_scores
from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.sessions.verdict import Verdict

VERBS = ["demo", "run", "doctor", "convert", "train", "evaluate", "live", "correct", "show", "info"]
MEASURES = ["pose", "speed", "sizes", "tables", "reference", "tracking", "scenes"]


def liex(
    *arguments: str, code: str = "from liex_lab.cli import main; main()", timeout_s: float = 60.0
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s)


def job(monkeypatch: pytest.MonkeyPatch, module: str, **functions: Any) -> None:
    """Put functions in the place of a job, which the command line imports when it is asked for."""
    stand_in = ModuleType(f"liex_lab.pipelines.{module}")
    for name, function in functions.items():
        setattr(stand_in, name, function)
    monkeypatch.setitem(sys.modules, stand_in.__name__, stand_in)


def test_help_is_quick() -> None:
    """Half a second is promised; the limit here leaves room for a machine that is busy with other
    tests.
    """
    liex("--help")  # the first call writes the byte code
    walls = []
    for _ in range(3):
        begin = time.perf_counter()
        assert liex("--help").returncode == 0
        walls.append(time.perf_counter() - begin)
    assert min(walls) < 1.0, f"liex --help took {min(walls):.2f} s"


@pytest.mark.parametrize(
    "words", [[], *([verb] for verb in VERBS), *(["evaluate", name] for name in MEASURES)]
)
def test_every_verb_explains_itself(words: list[str]) -> None:
    result = CliRunner().invoke(cli.app, [*words, "--help"])
    assert result.exit_code == 0, result.output
    expected = VERBS if not words else MEASURES if words == ["evaluate"] else ["--help"]
    assert all(word in result.output for word in expected)


IMPERATIVES = {
    *(
        "Apply",
        "Check",
        "Compare",
        "Correct",
        "Draw",
        "Edit",
        "Exchange",
        "List",
        "Make",
        "Measure",
    ),
    *("Move", "Open", "Pack", "Rename", "Report", "Score", "Set", "Show", "Take", "Train", "Turn"),
    *("Write",),
}


@pytest.mark.parametrize("words", [[], ["evaluate"], ["correct"]])
def test_the_list_of_verbs_is_whole_on_a_narrow_screen_and_each_begins_with_a_verb(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = CliRunner().invoke(cli.app, [*words, "--help"], env={"COLUMNS": "80"}).output
    lists = printed.split("--help")[1]
    begun = re.findall(r"^  [a-z]+ +([A-Z]\w+)", lists, re.MULTILINE)
    assert len(begun) >= 6
    assert set(begun) <= IMPERATIVES, set(begun) - IMPERATIVES
    assert "..." not in lists


def test_it_says_which_version_it_is() -> None:
    assert CliRunner().invoke(cli.app, ["--version"]).output == f"liex_lab {liex_lab.__version__}\n"


def test_python_m_is_the_same_command() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "liex_lab", "--version"], capture_output=True, text=True
    )
    assert ran.stdout == f"liex_lab {liex_lab.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "nothing.mcap", "--plan", "moose"], "did you mean 'mouse'"),
        (["run", "nothing.mcap", "--set", "camera.fxx=3"], "nearest one is camera.fx"),
        (["info", "--plan", "moose"], "did you mean 'mouse'"),
        (["show", "nothing.liex"], "nothing.liex"),
    ],
)
def test_a_mistake_is_one_sentence_and_exit_code_1(arguments: list[str], says: str) -> None:
    ran = liex(*arguments)
    assert ran.returncode == 1
    assert ran.stdout == ""
    assert says in ran.stderr
    assert len(ran.stderr.strip().splitlines()) == 1, "one line, without a traceback"


def test_a_call_that_is_wrong_is_exit_code_2() -> None:
    assert liex("run").returncode == 2
    assert liex("fly").returncode == 2


BREAK = (
    "import liex_lab.plan, liex_lab.cli as c\ndef broken(*a): {}\nliex_lab.plan.Plan.load = "
    "broken\nc.main()"
)


def test_a_fault_of_ours_says_so_and_shows_where() -> None:
    ran = liex("info", "--plan", "mouse", code=BREAK.format("raise ZeroDivisionError('oh')"))
    assert ran.returncode == cli.FAULT
    assert "ZeroDivisionError: oh" in ran.stderr
    assert "a fault of liex_lab" in ran.stderr.splitlines()[-1]


def test_a_full_disk_is_a_sentence() -> None:
    ran = liex(
        "info",
        "--plan",
        "mouse",
        code=BREAK.format("raise OSError(28, 'No space left on device', 'a.mcap')"),
    )
    assert ran.returncode == 1
    assert "the disk that holds a.mcap is full (No space left on device)" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1
    assert "Traceback" not in ran.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="signals differ")
def test_interrupting_leaves_without_a_traceback() -> None:
    wait = BREAK.format("print('begun', flush=True); import time; time.sleep(30)")
    command = [sys.executable, "-c", wait, "info", "--plan", "mouse"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # heeded, though the tests may have been started to ignore it
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        assert running.stdout.readline() == "begun\n"
        running.send_signal(signal.SIGINT)
        assert running.wait(20) == 130
        assert "Traceback" not in running.stderr.read()


def test_run_hands_the_plan_with_its_settings_to_the_job(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}

    def run_session(
        recording: Path, plan: Plan, out: Path, *, overwrite: bool, progress: Any, **_: Any
    ) -> Path:
        progress(1, 2, "working")
        progress(2, 2, "working")
        progress(0, None, "closing")
        seen.update(recording=recording, plan=plan, out=out, overwrite=overwrite)
        session = out / "m01.liex"
        session.mkdir()
        (session / "report.html").touch()
        return session

    monkeypatch.setattr("liex_lab.api.run_session", run_session)
    words = [
        "run",
        "m01.mcap",
        "--plan",
        "mouse",
        "--set",
        "animal.spine_mm=65",
        "--set",
        "seed=4",
        "--out",
        str(tmp_path),
        "--overwrite",
    ]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert seen["plan"] == Plan.load("mouse").with_settings(["animal.spine_mm=65", "seed=4"])
    assert (seen["recording"], seen["out"], seen["overwrite"]) == (Path("m01.mcap"), tmp_path, True)
    assert f"session: {tmp_path / 'm01.liex'}" in result.output
    assert f"report:  {tmp_path / 'm01.liex' / 'report.html'}" in result.output


@pytest.mark.parametrize(
    ("reasons", "accepted", "code"), [([], False, 0), (["it is huge"], False, 4), (["x"], True, 0)]
)
def test_run_ends_with_how_it_went_and_exit_code_4_where_someone_has_to_look(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    reasons: list[str],
    accepted: bool,
    code: int,
) -> None:
    def run_session(recording: Path, plan: Plan | None, out: Path, **how: Any) -> Path:
        assert plan is None, "none was named"
        assert how["settings"] == ["estimation.accept_misfit=true"] * accepted
        verdict = Verdict(9, 9, 8, 7, 2.0, 1, tuple(reasons), (), accepted)
        (out / "session.json").write_text(json.dumps({"verdict": verdict.to_dict()}))
        return out

    monkeypatch.setattr("liex_lab.api.run_session", run_session)
    words = ["run", "m01.mcap", "--out", str(tmp_path), *["--accept"] * accepted]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == code, result.output
    size = (tmp_path / "session.json").stat().st_size
    assert f"on disk: {size / 1e6:.1f} MB" in result.output
    last = result.output.strip().splitlines()[-1]
    assert last.startswith("result:  9 frames, 8 with a pose (89%), 7 of them trusted")
    assert ("look at it" in last) == bool(reasons)


def test_a_recording_that_does_not_fit_its_plan_is_a_sentence_and_exit_code_4() -> None:
    told = "from liex_lab.errors import MisfitError\n" + BREAK.format(
        "raise MisfitError('too long')"
    )
    ran = liex("info", "--plan", "mouse", code=told)
    assert (ran.returncode, ran.stdout) == (4, "")
    assert ran.stderr.strip() == "liex: too long"


def test_demo_ends_with_the_path_of_a_session(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("liex_lab.api.run_demo", lambda out, progress: out / "sample.liex")
    result = CliRunner().invoke(cli.app, ["demo", "--out", str(tmp_path)])
    assert f"session: {tmp_path / 'sample.liex'}" in result.output


def test_doctor_prints_json_that_holds_no_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = {
        "format": "mcap",
        "n_frames": np.int64(3),
        "fx": np.float32(365),
        "floor_mm": math.nan,
        "problems": ["a"],
    }
    job(
        monkeypatch,
        "doctor",
        examine=lambda path, **options: findings,
        print_report=lambda findings, verbose: print(verbose),
    )
    result = CliRunner().invoke(cli.app, ["doctor", "m01.mcap", "--json"])
    expected = {"format": "mcap", "n_frames": 3, "fx": 365.0, "floor_mm": None, "problems": ["a"]}
    assert json.loads(result.output) == expected
    assert CliRunner().invoke(cli.app, ["doctor", "m01.mcap"]).output == "False\n"
    assert CliRunner().invoke(cli.app, ["doctor", "m01.mcap", "--verbose"]).output == "True\n"


def test_evaluate_pose_writes_its_numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[Any] = []

    def evaluate_pose(animal: str, split: str, variant: str, **options: Any) -> dict[str, Any]:
        options.pop("progress")(1, 1, "frames")
        seen.extend([animal, split, variant, options])
        return {
            "animal": animal,
            "mean_joint_error_mm": 2.5,
            "protocol": "mean over joints [mm]",
            "curve": np.arange(2),
        }

    job(monkeypatch, "evaluation.pose", evaluate_pose=evaluate_pose)
    file = tmp_path / "numbers" / "pose.json"
    words = [
        "--animal",
        "mouse",
        "--split",
        "hard",
        "--variant",
        "paper",
        "--frames",
        "50",
        "--spine-mm",
        "65",
    ]
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", *words, "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert seen == ["mouse", "hard", "paper", {"model": None, "n_frames": 50, "spine_mm": 65.0}]
    assert json.loads(file.read_text())["curve"] == [0, 1]
    assert "mean over joints [mm]" in result.output, "brackets are text, not markup"


def test_evaluate_scenes_tells_one_line_a_scene(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Any] = []

    def evaluate_scenes(only: list[str], **options: Any) -> dict[str, Any]:
        options.pop("progress")(0, 1, "scene plain")
        seen.extend([only, options])
        row = {"found": 0.98765, "hidden_right": None, "said": ["look here", "and here"]}
        return {"rows": {"plain": row}, "protocol": "found: share"}

    job(monkeypatch, "evaluation.scenes", evaluate_scenes=evaluate_scenes)
    file = tmp_path / "scenes.json"
    words = ["--only", "plain, raised", "--frames", "60", "--json", str(file)]
    result = CliRunner().invoke(cli.app, ["evaluate", "scenes", *words])
    assert result.exit_code == 0, result.output
    assert seen[0] == ["plain", "raised"]
    assert seen[1] == {"n_frames": 60, "n_recordings": 1, "sealed": False, "draw": None}
    assert "| plain | 0.988 | – | look here; and here |" in result.output
    assert json.loads(file.read_text())["rows"]["plain"]["hidden_right"] is None


def test_the_other_measures_reach_their_jobs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    job(
        monkeypatch,
        "evaluation.speed",
        evaluate_speed=lambda animal, progress: {
            "animal": animal,
            "stages_ms": {"foreground": 0.1},
        },
    )
    job(
        monkeypatch,
        "evaluation.pose",
        evaluate_sizes=lambda animal, n_frames, progress: {"n_frames": n_frames},
        evaluate_reference=lambda session, reference: {
            "session": str(session),
            "reference": str(reference),
        },
    )
    speed, sizes, reference = (
        tmp_path / f"{name}.json" for name in ("speed", "sizes", "reference")
    )
    runner = CliRunner()
    runner.invoke(cli.app, ["evaluate", "speed", "--json", str(speed)])
    runner.invoke(cli.app, ["evaluate", "sizes", "--json", str(sizes)])
    runner.invoke(
        cli.app,
        ["evaluate", "reference", "m.liex", "--reference", "r.csv", "--json", str(reference)],
    )
    assert json.loads(speed.read_text()) == {"animal": "mouse", "stages_ms": {"foreground": 0.1}}
    assert json.loads(sizes.read_text()) == {"n_frames": None}
    assert json.loads(reference.read_text()) == {"session": "m.liex", "reference": "r.csv"}


def test_evaluate_tables_names_what_it_wrote(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Any] = []

    def run_tables(out: Path, animals: Any, **options: Any) -> list[Path]:
        options.pop("progress")(1, None, "drawing")
        seen.extend([out, list(animals), options])
        return [out / "tables.md"]

    monkeypatch.setattr(api, "run_tables", run_tables)
    words = [
        "--out",
        str(tmp_path),
        "--animal",
        "mouse",
        "--animal",
        "fish",
        "--frames",
        "50",
        "--quick",
    ]
    result = CliRunner().invoke(cli.app, ["evaluate", "tables", *words])
    assert result.output == f"{tmp_path / 'tables.md'}\n"
    whole = {"without": (), "nyu": None}
    fewer = {"n_frames": 50, "quick": True, "fresh": False, "rows": (), "sealed": False, **whole}
    assert seen == [tmp_path, ["mouse", "fish"], fewer]
    seen.clear()
    more = ["--row", "rf", "--sealed", "--without", "tracking", "--nyu", str(tmp_path)]
    CliRunner().invoke(cli.app, ["evaluate", "tables", *words[:4], *more])
    sealed = {"n_frames": None, "quick": False, "fresh": False, "rows": ["rf"], "sealed": True}
    parts = {"without": ["tracking"], "nyu": tmp_path}
    assert seen == [tmp_path, ["mouse"], sealed | parts]


def test_the_help_of_the_tables_says_in_what_they_differ_from_the_paper() -> None:
    told = " ".join(CliRunner().invoke(cli.app, ["evaluate", "tables", "--help"]).output.split())
    for sentence in DEVIATIONS:
        assert sentence in told


def test_evaluate_speed_measures_recordings_where_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    numbers = {"frames_per_s_1core": {"mcap": 400.0}}
    job(monkeypatch, "evaluation.recordings", evaluate_recordings=lambda progress: numbers)
    file = tmp_path / "numbers.json"
    result = CliRunner().invoke(cli.app, ["evaluate", "speed", "--recordings", "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert json.loads(file.read_text()) == numbers


def test_convert_says_what_was_written_and_what_is_odd(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}

    def convert(recording: Path, to: Path, *, progress: Any, **how: Any) -> Any:
        seen.update(how, recording=recording, to=to)
        return SimpleNamespace(path=to, n_frames=7, notes=["a [note]"], problems=["it was cut"])

    job(monkeypatch, "convert", convert=convert)
    words = [
        "convert",
        "a.bag",
        "--to",
        "b.mcap",
        "--topic",
        "/d",
        "--step-mm",
        "0.1",
        "--fps",
        "30",
        "--overwrite",
    ]
    result = CliRunner().invoke(cli.app, words)
    assert result.output == "recording: b.mcap (7 frames)\nnote: it was cut\nnote: a [note]\n"
    assert seen == {
        "recording": Path("a.bag"),
        "to": Path("b.mcap"),
        "topic": "/d",
        "step_mm": 0.1,
        "fps": 30.0,
        "ros": False,
        "overwrite": True,
    }


def test_run_hands_the_topic_to_the_plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[tuple[Plan | None, list[str]]] = []

    def run_session(recording: Path, plan: Plan | None, out: Path, **how: Any) -> Path:
        seen.append((plan, how["settings"]))
        return out

    monkeypatch.setattr("liex_lab.api.run_session", run_session)
    words = ["run", "m01.mcap", "--topic", "/left/depth", "--out", str(tmp_path)]
    CliRunner().invoke(cli.app, [*words, "--plan", "mouse"])
    CliRunner().invoke(cli.app, words)
    (plan, _), (unnamed, settings) = seen
    assert plan is not None
    assert plan.recording.topic == "/left/depth"
    assert (unnamed, settings) == (None, ["recording.topic=/left/depth"])


@pytest.mark.parametrize(("n", "counted"), [(1, "1 file"), (2, "2 files")])
def test_files_are_counted_in_the_singular_and_plural(
    n: int, counted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = {"files": ["a.svg"] * n, "empty": [], "folder": "there"}
    monkeypatch.setattr(api, "draw_figures", lambda *_, **__: drawn)
    result = CliRunner().invoke(cli.app, ["figures", "NAME.liex"])
    assert result.output == f"figures: {counted} in there\n"


def test_train_names_the_model_after_the_animal(monkeypatch: pytest.MonkeyPatch) -> None:
    def train(
        animal: str, variant: str, out: Path, workers: int, n_images: int | None, progress: Any
    ) -> Any:
        return out, variant, workers, n_images

    job(monkeypatch, "training.pose_model", train_model=train)
    result = CliRunner().invoke(cli.app, ["train", "mouse", "--variant", "paper", "--workers", "2"])
    assert result.output == f"model: {(Path('mouse.npz'), 'paper', 2, None)}\n"
    result = CliRunner().invoke(cli.app, ["train", "datasets/snake.toml", "--images", "512"])
    assert result.output == f"model: {(Path('snake.npz'), 'default', 0, 512)}\n"


def test_the_noise_of_particles_is_searched_on_as_many_frames_as_are_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def search(animal: str, *, n_frames: int | None, progress: Any) -> dict[str, Any]:
        return {"animal": animal, "n_frames": n_frames}

    job(monkeypatch, "evaluation.tracking", search_noise=search)
    words = ["train", "tracking", "--animal", "fish", "--particles", "--frames", "60"]
    file = tmp_path / "noise.json"
    assert CliRunner().invoke(cli.app, [*words, "--json", str(file)]).exit_code == 0
    assert json.loads(file.read_text()) == {"animal": "fish", "n_frames": 60}


def test_errors_of_a_job_come_through(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def examine(path: Path, **options: Any) -> dict[str, Any]:
        raise RecordingError(f"{path} holds colour [uint8], not depth")

    job(monkeypatch, "doctor", examine=examine, print_report=print)
    monkeypatch.setattr(sys, "argv", ["liex", "doctor", "colour.png"])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 1
    assert capsys.readouterr().err == "liex: colour.png holds colour [uint8], not depth\n"


def test_info_tells_versions_and_plans_and_prints_a_plan_to_copy() -> None:
    told = CliRunner().invoke(cli.app, ["info"]).output
    assert all(word in told for word in ("liex_lab", "python", "plans", "mouse", "models"))
    assert len(told.splitlines()) < 20
    told = CliRunner().invoke(cli.app, ["info", "--all"]).output
    assert all(word in told for word in ("numba", "rerun-sdk", "plans", "mouse", "models"))
    assert (
        CliRunner().invoke(cli.app, ["info", "--plan", "mouse"]).output
        == Plan.load("mouse").to_toml()
    )


def test_scores_of_a_trained_recogniser_are_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    go = {"f1": 0.5, "precision": 0.25, "recall": 1.0, "segment_f1_50": 0.5, "bouts": 7}
    tell_scores({"animals": 2, "macro_f1": 0.5, "segment_f1_50": 0.5, "per_action": {"go": go}})
    told = capsys.readouterr().out
    assert "macro F1 of the frames 0.50" in told
    (row,) = [line for line in told.splitlines() if "go" in line]
    assert [cell.strip() for cell in row.split("│")[1:-1]] == ["go", "7", "0.50", "25%", "100%"]
    tell_scores({"animals": 1, "note": "one animal only"})
    assert capsys.readouterr().out == "animals: 1\nnote: one animal only\n"
    tell_scores({})
    assert capsys.readouterr().out == ""


def test_train_actions_keeps_its_scores_as_json(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    report = {"animals": 1, "note": "one animal only"}
    job(monkeypatch, "training.action_model", train_actions=lambda out, **how: (out, report))
    kept = tmp_path / "scores.json"
    result = CliRunner().invoke(cli.app, ["train", "actions", "--json", str(kept)])
    assert result.output == "animals: 1\nnote: one animal only\nmodel: mouse-actions.skops\n"
    assert json.loads(kept.read_text()) == report


def test_help_shows_the_verbs_in_the_order_of_work() -> None:
    told = CliRunner().invoke(cli.app, ["--help"]).output
    verbs = re.findall(r"^  ([a-z]+)  ", told, re.MULTILINE)
    start = ["demo", "doctor", "run", "show"]
    assert verbs[:4] == start
    assert verbs.index("cohort") < verbs.index("compare") < verbs.index("evaluate")
