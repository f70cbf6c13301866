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
LIMITS = {
    "pictures?": 37,
    "told": 17,
    "tells?": 18,
    "seen": 62,
    "said": 14,
    "says?": 115,
    "whom?": 33,
    "looks?": 130,
    "looked": 7,
    "anew": 4,
    "things?": 1,
    "put right": 0,
    "bear out": 1,
    "by far": 0,
    "wants": 1,
    "is none": 58,
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
    return {word: len(re.findall(rf"(?<![A-Za-z]){word}(?![A-Za-z])", text)) for word in LIMITS}


@pytest.mark.checks
def test_words_of_our_own_only_become_fewer() -> None:
    more = {word: n for word, n in count_words().items() if n > LIMITS[word]}
    assert not more, f"use the field's terms (CONTRIBUTING.md); used more often than before: {more}"


if __name__ == "__main__":
    for word, n in count_words().items():
        print(f"{n:5d} of {LIMITS[word]:5d}  {word}")
