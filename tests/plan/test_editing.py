"""One value put into a TOML file that a person wrote: all else stays, to the letter."""

import random
import tomllib
from typing import Any

import pytest
from liex_lab.pipelines.region_config import with_value

from liex_lab.errors import PlanError
from liex_lab.plan import Plan

REGION = [[10.0, 20.5], [200.0, 20.0], [150.0, 180.0]]
STUDY = '''\
# our study of spring # 2
name = "spring"     # a name
plan = 'mouse'
text = """a [trap] = "here"
# no comment"""

[set.animal]  # all of them
spine_mm = 80.0

[[arenas]]
name = "left"
region = [
    [1, 2],  # the door
    [90, 2],
    [90, 90],
]

[[animals]]
id = "m01"
set = { animal = { spine_mm = 70 } }   # a small one

[[sessions]]
animal = "m01"
session = "01"
recording = "rawdata/a.oni"  # the first

[[sessions]]
animal = "m01"
session = "02"
recording = "rawdata/b.oni"
[sessions.set.arena]
zones = "zones.toml"
[sessions.set.session]
cage = "c1"

[[sessions]]  # the last
animal = "m01"
session = "03"
recording = "rawdata/c.oni"
set.arena.region.rectangle = [[0, 0], [50, 50]]
set.arena.region.unit = "px"
'''
PLACES = [
    ("set", "arena", "region"),
    ("arenas", 0, "region"),
    ("animals", 0, "set", "arena", "region"),
    *(("sessions", k, "set", "arena", "region") for k in range(3)),
]


def at(table: Any, path: tuple[str | int, ...]) -> Any:
    for part in path:
        table = table[part]
    return table


@pytest.mark.parametrize("path", PLACES, ids=str)
@pytest.mark.parametrize("line", ["\n", "\r\n"])
def test_a_value_is_put_in_and_every_comment_stays(path: tuple[str | int, ...], line: str) -> None:
    text = STUDY.replace("\n", line)
    made = with_value(text, path, REGION)
    assert at(tomllib.loads(made), path) == REGION
    comments = [part.split("#", 1)[1] for part in text.split(line) if "#" in part]
    lost = [one for one in comments if one not in made]
    assert lost == ([" the door"] if path[0] == "arenas" else [])  # within the value itself
    assert made.count("\n") == made.count(line)
    again = with_value(made, path, REGION)
    assert again == made


@pytest.mark.parametrize("path", PLACES, ids=str)
def test_what_was_put_in_is_taken_out_again(path: tuple[str | int, ...]) -> None:
    made = with_value(with_value(STUDY, path, REGION), path, None)
    with pytest.raises(KeyError):
        at(tomllib.loads(made), path)
    assert with_value(made, path, None) == made


def test_a_plan_keeps_its_text_and_the_line_of_what_was_not_set_is_used() -> None:
    text = Plan.load("mouse").to_toml()
    made = with_value(text, ("arena", "region"), REGION)
    assert Plan.from_toml(made) == Plan.load("mouse").with_settings([f"arena.region={REGION}"])
    changed = [
        pair for pair in zip(text.split("\n"), made.split("\n"), strict=True) if len({*pair}) > 1
    ]
    assert changed == [("# region =", f"region = {REGION}")]


def test_random_files_come_out_with_one_value_changed() -> None:
    """Whatever a file looks like, the rest of what it says is the same, or it is not touched."""
    rng = random.Random(3)
    values = [
        "1",
        '"a # b"',
        "'x = [1]'",
        "[1, # c\n 2]",
        "{ y = { z = 1 } }",
        "1979-05-27",
        "true",
    ]
    done = 0
    for _ in range(120):
        lines = [f"k{k} = {rng.choice(values)}  # {k}" for k in range(rng.randrange(3))]
        for k in range(rng.randrange(4)):
            lines += [rng.choice([f"[t{k}]", "[[many]]", f"[a.'b c'.t{k}]", f"[set.u{k}]"])]
            key = rng.choice(["a", "b.c", '"q.r"'])
            lines += [f"{key} = {rng.choice(values)}"]
        text = "\n".join(lines) + rng.choice(["", "\n", "\n\n# the end"])
        path = rng.choice([("set", "arena", "region"), ("arena", "region"), ("k0",), ("t1", "a")])
        try:
            before = tomllib.loads(text)
            made = with_value(text, path, REGION)
        except (PlanError, tomllib.TOMLDecodeError):
            continue
        done += 1
        after = tomllib.loads(made)
        assert at(after, path) == REGION
        inner = after
        for part in path[:-1]:
            inner = inner[part]
        inner.pop(path[-1])
        for name in {*before, *after} - {path[0]}:
            assert before[name] == after[name]
    assert done > 60


def test_what_cannot_be_changed_is_a_sentence() -> None:
    with pytest.raises(PlanError, match="the file should be a TOML file"):
        with_value("a = [", ("b",), 1)
    with pytest.raises(PlanError, match="there is no table sessions"):
        with_value(STUDY, ("sessions", 7, "x"), 1)
    many = "many = [{ a = 1 }, { a = 2 }]\n"
    assert tomllib.loads(with_value(many, ("many", 1, "a"), 3))["many"][1]["a"] == 3
