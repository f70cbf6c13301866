"""The animal of a recording is found whatever day, session or date stands beside it."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.plan.study import (
    alike,
    animal_part,
    find_subject,
    letters,
    one_animal,
    references_first,
    same,
)

ANIMALS = st.sampled_from(["m1", "m01", "mouse3", "A12", "rat7", "c2m3", "F0412", "m250"])
DAYS = ["day1", "d2", "s1", "ses-01", "ses01", "session2", "rec3", "trial4", "wk2", "test", "t1"]
DAYS += ["habituation", "baseline", "run2", "visit3", "post", "24h", "openfield", "recording 5"]
DATES = ["20260821", "2026-08-21", "20260821T101500", "260821", "21.08.2026", "21Aug2026"]
DATES += ["082126", "210826", "012517"]


@settings(max_examples=40, deadline=None)
@given(
    animal=ANIMALS,
    endings=st.tuples(st.sampled_from(["", *DATES]), st.sampled_from(["", *DAYS])),
    apart=st.sampled_from("_- "),
    upper=st.booleans(),
    depth=st.booleans(),
)
def test_an_ending_of_any_kind_in_any_case_leaves_the_animal(animal, endings, apart, upper, depth):
    name = apart.join([animal, *filter(None, endings), *["depth"] * depth])
    found = find_subject(
        Path("/raw") / f"{name.upper() if upper else name}.mcap", root=Path("/raw")
    )
    assert found.id.lower() == animal.lower()
    assert find_subject(Path("/elsewhere") / f"{name}.mcap").id == animal


@pytest.mark.parametrize("date", ["012517", "123117", "250117", "311217"])
@pytest.mark.parametrize(
    "name", ["m01_{}", "m01-{}_depth", "Bella {}", "m01_{}_day2", "cage2_m1_{}"]
)
def test_a_date_of_six_digits_behind_a_name_with_letters_is_an_occasion(name, date):
    found = find_subject(Path("/raw") / f"{name.format(date)}.mcap", root=Path("/raw"))
    assert animal_part(name.format(date)) == animal_part(name.format("")).strip("_- ")
    assert date in found.session


def test_six_digits_that_are_no_date_or_have_no_letters_before_them_are_of_the_animal():
    for name in ("m01_321332", "rat_123456", "101_012517", "012517", "M_012517", "m01_011295"):
        assert animal_part(name) == name


@settings(max_examples=25, deadline=None)
@given(names=st.lists(st.text(min_size=1, max_size=80), min_size=2, max_size=2))
def test_letters_and_digits_are_all_that_an_id_holds(names):
    for name in names:
        assert letters(name).isascii()
        assert letters(name).isalnum()
        assert len(letters(name)) <= 64
        assert same(same(name)) == same(name)


def test_ids_of_different_animals_stay_apart():
    ids = ["101-2", "10-12", "小白", "小黑", "cre+1", "cre1", "a" * 70, "a" * 70 + "b"]
    assert len({letters(one) for one in ids}) == len(ids)
    assert one_animal(["m1", "m01", "m10", "c2m3", "c2m4", "A12", "A12b"]) == []
    assert alike(["+/+", "+/-", "-/-", "1-12", "11-2"]) == []


def test_a_group_named_like_a_control_comes_first():
    assert references_first(["drug", "vehicle", "high"]) == ["vehicle", "drug", "high"]
    assert references_first(["ko", "WT"]) == ["WT", "ko"]
    assert references_first(["b", "a"]) == ["a", "b"]
