"""One noun, one word, the field's: `python -m tests.test_words` counts the words that should go.

A limit is what is left today. It only ever goes down; at 0 the word is gone.
"""

import re
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
COUNTED = (
    "liex_lab",
    "pipelines",
    "dashboards",
    "docs",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
)
ENDINGS = {".py", ".md", ".toml", ".html", ".j2", ".mjs", ".js"}
KEPT = (  # not counted
    # keys and files of sessions, studies and results, and a key of the browser's storage: they stay
    # readable
    "look_at_it",
    "look.json",
    "whole_picture",
    '"picture"',
    "`picture`",
    "seen_share",
    '_OBSERVED = "seen"',
    "-seen-",
    "plan_says",
    '"said"',
    " said: ",
    '"told"',
    "liex-looked-",
    "cutout {k + 1} in the picture",
    # stored in models
    "tells_facing",
    "and looks about",
    "no picture of a hand was used",
    # Python's file method, Rerun's argument, and words in the users' file names
    ".tell()",
    "look_target",
    "|pictures?|",
    # former spellings in CHANGELOG.md
    "`look at it`",
    "`--pictures`",
    "`told=`",
    "`say=`",
)
LIMITS = {
    "pictures?": 0,
    "told": 0,
    "tells?": 0,
    "seen": 0,
    "said": 0,
    "says?": 0,
    "whom?": 0,
    "looks?": 0,
    "looked": 0,
    "anew": 0,
    "things?": 0,
    "put right": 0,
    "bear out": 0,
    "by far": 0,
    "wants": 0,
    "is none": 0,
    "Wanted": 0,
    "Listed": 0,
    "put_in": 0,
    "Standing": 0,
    "stating": 0,
    "METHOD lesson": 0,
}


def count_words() -> dict[str, int]:
    """Occurrences of each word in the product and its manual."""
    listed = subprocess.run(
        ["git", "ls-files", "--", *COUNTED],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    paths = [REPOSITORY / name for name in listed.stdout.split("\n") if name]
    text = "\n".join(path.read_text(encoding="utf-8") for path in paths if path.suffix in ENDINGS)
    for name in KEPT:
        text = text.replace(name, "")
    return {word: len(re.findall(rf"(?<![A-Za-z]){word}(?![A-Za-z])", text)) for word in LIMITS}


@pytest.mark.checks
def test_words_of_our_own_only_become_fewer() -> None:
    more = {word: n for word, n in count_words().items() if n > LIMITS[word]}
    assert not more, f"use the field's terms (CONTRIBUTING.md); used more often than before: {more}"


if __name__ == "__main__":
    for word, n in count_words().items():
        print(f"{n:5d} of {LIMITS[word]:5d}  {word}")
