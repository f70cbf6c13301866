"""The command line: quick to ask, one sentence and exit code 1 for what the user can put right,
JSON that is JSON.
"""

import json
import math
import re
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
from liex_lab.cli.options import print_scores
from liex_lab.errors import MisfitError, RecordingError
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
    for _ in range(2):
        begin = time.perf_counter()
        assert liex("--help").returncode == 0
        walls.append(time.perf_counter() - begin)
    assert min(walls) < 1.0, f"liex --help took {min(walls):.2f} s"


@pytest.mark.parametrize("words", [[], ["evaluate"], ["run"], ["train"], ["evaluate", "tables"]])
def test_every_verb_explains_itself(words: list[str]) -> None:
    result = CliRunner().invoke(cli.app, [*words, "--help"])
    assert result.exit_code == 0, result.output
    expected = VERBS if not words else MEASURES if words == ["evaluate"] else ["--help"]
    assert all(word in result.output for word in expected)


IMPERATIVES = {
    *("Apply", "Check", "Compare", "Confirm", "Convert", "Correct", "Draw", "Edit", "Exchange"),
    *("Export", "List", "Make", "Measure", "Move", "Open", "Pack", "Put", "Record", "Redo"),
    *("Regenerate", "Report", "Score", "Set", "Show", "Train", "Undo", "Write"),
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


def test_python_m_is_the_same_command() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "liex_lab", "--version"], capture_output=True, text=True
    )
    assert ran.stdout == f"liex_lab {liex_lab.__version__}\n"


def test_a_wrong_call_is_exit_code_2_and_a_mistake_one_sentence_and_exit_code_1() -> None:
    assert CliRunner().invoke(cli.app, ["run"]).exit_code == 2
    assert CliRunner().invoke(cli.app, ["fly"]).exit_code == 2
    ran = liex("show", "nothing.liex")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert "nothing.liex" in ran.stderr
    assert len(ran.stderr.strip().splitlines()) == 1, "one line, without a traceback"


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ZeroDivisionError("oh"), cli.FAULT, "a fault of liex_lab"),
        (OSError(28, "No space left on device", "a.mcap"), 1, "the disk that holds a.mcap is full"),
        (MisfitError("too long"), 4, "liex: too long"),
        (RecordingError("a.png holds colour"), 1, "liex: a.png holds colour"),
    ],
)
def test_errors_of_a_job_have_a_sentence_and_a_code(
    error: Exception,
    code: int,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def examine(path: Path, **options: Any) -> dict[str, Any]:
        raise error

    job(monkeypatch, "doctor", examine=examine, print_report=print)
    monkeypatch.setattr(sys, "argv", ["liex", "doctor", "a.png"])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert says in lines[-1]
    assert len(lines) == 1 or code == cli.FAULT
    assert ("ZeroDivisionError: oh" in lines) == (code == cli.FAULT)


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
    words = "run m01.mcap --plan mouse --topic /left --set animal.spine_mm=65 --overwrite --out"
    result = CliRunner().invoke(cli.app, [*words.split(), str(tmp_path)])
    assert result.exit_code == 0, result.output
    stated = ["animal.spine_mm=65", "recording.topic=/left"]
    assert seen["plan"] == Plan.load("mouse").with_settings(stated)
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
        accept = ["estimation.accept_misfit=true"] * accepted
        assert how["settings"] == ["recording.topic=/left", *accept]
        verdict = Verdict(9, 9, 8, 7, 2.0, 1, tuple(reasons), (), accepted)
        (out / "session.json").write_text(json.dumps({"verdict": verdict.to_dict()}))
        return out

    monkeypatch.setattr("liex_lab.api.run_session", run_session)
    words = ["run", "m01.mcap", "--topic", "/left", "--out", str(tmp_path)]
    result = CliRunner().invoke(cli.app, [*words, *["--accept"] * accepted])
    assert result.exit_code == code, result.output
    size = (tmp_path / "session.json").stat().st_size
    assert f"on disk: {size / 1e6:.1f} MB" in result.output
    last = result.output.strip().splitlines()[-1]
    assert last.startswith("result:  9 frames, 8 with a pose (89%), 7 of them trusted")
    assert ("needs review" in last) == bool(reasons)


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


SCENE = {"found": 0.98765, "hidden_right": None, "said": ["look here", "and here"]}
ACTIONS = {"animals": 1, "note": "one animal only"}
WRITTEN = SimpleNamespace(path="b.mcap", n_frames=7, notes=["a [note]"], problems=["it was cut"])
# words; job; what it returns; its arguments and options; what is printed
CALLS: list[tuple[str, str, Any, tuple[Any, ...], dict[str, Any], str]] = [
    (
        "evaluate pose --animal mouse --split hard --variant paper --frames 50 --spine-mm 65",
        "evaluation.pose.evaluate_pose",
        {"protocol": "mean over joints [mm]", "curve": np.arange(2)},
        ("mouse", "hard", "paper"),
        {"model": None, "n_frames": 50, "spine_mm": 65.0},
        "mean over joints [mm]",  # brackets are text, not markup
    ),
    (
        "evaluate scenes --only plain,raised --frames 60",
        "evaluation.scenes.evaluate_scenes",
        {"rows": {"plain": SCENE}, "protocol": "found: share"},
        (["plain", "raised"],),
        {"n_frames": 60, "n_recordings": 1, "sealed": False, "figures": None},
        "| plain | 0.988 | – | look here; and here |",
    ),
    (
        "evaluate several --animals 3 --frames 300",
        "evaluation.several.evaluate_several",
        {"rows": {"all": {"idf1": 0.5, "interactions_true": {"macro_f1": 0.9, "f1": {}}}}},
        (3,),
        {
            "animal": "mouse",
            "n_frames": 300,
            "n_recordings": 6,
            "sealed": False,
            "courses": None,
        },
        "| all | 0.5 | 0.9 |",
    ),
    (
        "evaluate speed",
        "evaluation.speed.evaluate_speed",
        {"stages_ms": {"foreground": 0.1}},
        ("mouse",),
        {},
        "foreground",
    ),
    (
        "evaluate speed --recordings",
        "evaluation.speed.evaluate_recordings",
        {"frames_per_s_1core": {"mcap": 400.0}},
        (),
        {},
        "mcap",
    ),
    (
        "evaluate sizes",
        "evaluation.pose.evaluate_sizes",
        {"n": 1},
        ("mouse",),
        {"n_frames": None},
        "",
    ),
    (
        "evaluate reference m.liex --reference r.csv",
        "evaluation.pose.evaluate_reference",
        {"n": 1},
        (Path("m.liex"), Path("r.csv")),
        {},
        "",
    ),
    (
        "train tracking --animal fish --particles --frames 60",
        "evaluation.tracking.search_noise",
        {"animal": "fish"},
        ("fish",),
        {"n_frames": 60},
        "fish",
    ),
    (
        "train mouse --variant paper --workers 2",
        "training.pose_model.train_model",
        "made.npz",
        ("mouse", "paper", Path("mouse.npz")),
        {"workers": 2, "n_images": None},
        "model: made.npz\n",
    ),
    (
        "train datasets/snake.toml --images 512",
        "training.pose_model.train_model",
        "made.npz",
        ("datasets/snake.toml", "default", Path("snake.npz")),
        {"workers": 0, "n_images": 512},
        "model: made.npz\n",
    ),
    (
        "train actions",
        "training.action_model.train_actions",
        ("a.skops", ACTIONS),
        (Path("mouse-actions.skops"),),
        {"animal": "mouse", "sessions": (), "labels": (), "pose_model": None},
        "animals: 1\nnote: one animal only\nmodel: a.skops\n",
    ),
    (
        "convert a.bag --to b.mcap --topic /d --step-mm 0.1 --fps 30 --overwrite",
        "convert.convert",
        WRITTEN,
        (Path("a.bag"), Path("b.mcap")),
        {"topic": "/d", "step_mm": 0.1, "fps": 30.0, "ros": False, "overwrite": True},
        "recording: b.mcap (7 frames)\nnote: it was cut\nnote: a [note]\n",
    ),
]


@pytest.mark.parametrize(("words", "target", "returns", "given", "options", "printed"), CALLS)
def test_a_verb_hands_its_options_to_its_job_and_prints_and_keeps_the_result(
    words: str,
    target: str,
    returns: Any,
    given: tuple[Any, ...],
    options: dict[str, Any],
    printed: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    called: list[Any] = []

    def work(*arguments: Any, progress: Any = None, **more: Any) -> Any:
        called.extend([arguments, more])
        if progress is not None:
            progress(1, 1, "frames")
        return returns

    module, name = target.rsplit(".", 1)
    job(monkeypatch, module, **{name: work})
    file = tmp_path / "numbers" / "kept.json"
    numbers = returns[1] if isinstance(returns, tuple) else returns
    keep = ["--json", str(file)] if isinstance(numbers, dict) else []
    result = CliRunner().invoke(cli.app, [*words.split(), *keep])
    assert result.exit_code == 0, result.output
    assert called == [given, options]
    assert printed in result.output
    if keep:
        assert set(json.loads(file.read_text())) == set(numbers)


def test_evaluate_tables_names_what_it_wrote(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Any] = []

    def run_tables(out: Path, animals: Any, **options: Any) -> list[Path]:
        options.pop("progress")(1, None, "drawing")
        seen.extend([out, list(animals), options])
        return [out / "tables.md"]

    monkeypatch.setattr(api, "run_tables", run_tables)
    words = ["evaluate", "tables", "--out", str(tmp_path), "--animal", "mouse", "--row", "rf"]
    more = ["--sealed", "--without", "tracking", "--nyu", str(tmp_path), "--quick"]
    result = CliRunner().invoke(cli.app, [*words, *more])
    assert result.output == f"{tmp_path / 'tables.md'}\n"
    assert seen[:2] == [tmp_path, ["mouse"]]
    assert seen[2] == {
        "n_frames": None,
        "quick": True,
        "fresh": False,
        "rows": ["rf"],
        "sealed": True,
        "without": ["tracking"],
        "nyu": tmp_path,
    }


def test_the_help_of_the_tables_says_in_what_they_differ_from_the_paper() -> None:
    told = " ".join(CliRunner().invoke(cli.app, ["evaluate", "tables", "--help"]).output.split())
    for sentence in DEVIATIONS:
        assert sentence in told


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
    print_scores({"animals": 2, "macro_f1": 0.5, "segment_f1_50": 0.5, "per_action": {"go": go}})
    told = capsys.readouterr().out
    assert "macro F1 of the frames 0.50" in told
    (row,) = [line for line in told.splitlines() if "go" in line]
    assert [cell.strip() for cell in row.split("│")[1:-1]] == ["go", "7", "0.50", "25%", "100%"]
    print_scores({"animals": 1, "note": "one animal only"})
    assert capsys.readouterr().out == "animals: 1\nnote: one animal only\n"
    print_scores({})
    assert capsys.readouterr().out == ""


def test_help_shows_the_verbs_in_the_order_of_work() -> None:
    told = CliRunner().invoke(cli.app, ["--help"]).output
    verbs = re.findall(r"^  ([a-z]+)  ", told, re.MULTILINE)
    start = ["demo", "doctor", "run", "show"]
    assert verbs[:4] == start
    assert verbs.index("cohort") < verbs.index("compare") < verbs.index("evaluate")
