"""DANDI's own program takes our NWB files; collected where it is installed. It needs no network."""

import os
import subprocess
import sys
from pathlib import Path

from liex_lab.exchange import export

DANDI = Path(sys.executable).with_name("dandi")


def dandi(home: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a verb of DANDI's program, which asks nobody about newer versions of itself."""
    return subprocess.run(
        [DANDI, *words],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=home,
        env={**os.environ, "HOME": str(home), "NO_ET": "1", "DANDI_NO_ET": "1"},
    )


def test_dandi_puts_our_file_in_its_place_and_finds_nothing_wrong(session, tmp_path):
    file = export(session, "nwb", tmp_path / "forms")
    dandiset = tmp_path / "000027"
    dandiset.mkdir()
    (dandiset / "dandiset.yaml").write_text(
        "identifier: DANDI:000027\nname: mice\ndescription: mice that walk\n"
    )
    placed = dandi(tmp_path, "organize", "-d", dandiset, "--files-mode", "copy", file)
    assert placed.returncode == 0, placed.stdout + placed.stderr
    assert [str(path.relative_to(dandiset)) for path in dandiset.rglob("*.nwb")] == [
        "sub-m01/sub-m01.nwb"
    ]
    judged = dandi(tmp_path, "validate", dandiset)
    assert judged.returncode == 0, judged.stdout + judged.stderr
    assert "No errors found" in judged.stdout + judged.stderr
