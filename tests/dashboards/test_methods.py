"""What the Methods paragraph says of names, speed and length agrees with the tables."""

from typing import Any

import numpy as np
import pytest
from liex_lab.dashboards.report.report import methods, refusal_rows

from liex_lab.actions.vocabulary import WORDS
from liex_lab.sessions import Session

CARD = {
    "made_by": "liex train actions",
    "n_recordings": 32,
    "clock_hz": 30.0,
    "sha256": "33f6ffbae33a3539af6c",
}
GENERATED = "those of generated recordings; no recording of an animal was used"


@pytest.fixture
def session(walker: Session) -> Session:
    return Session.open(walker.path)


def named_by(session: Session, source: str, **facts: Any) -> Session:
    """The same session, its bouts named by somebody else."""
    bouts = session.bouts.assign(source=source, model_hash="33f6" if source == "model" else "")
    session.__dict__["bouts"] = bouts
    session.metadata.update(facts)
    return session


def test_rules_are_said_to_have_named_where_rules_did(session: Session) -> None:
    text = " ".join(methods(session))
    assert set(session.bouts["source"]) == {"rule"}
    assert "given by rule" in text
    assert "trained recogniser" not in text
    assert "0.33 s between them were joined" in text
    assert "5 cm/s to 30 cm/s" in text


def test_a_model_is_named_with_what_it_learned_from(session: Session) -> None:
    words = {word: one.printed for word, one in WORDS["mouse"].items()}
    refusal = {"action": "pause", "start_s": 1.0, "stop_s": 1.5, "named": "", "why": "too fast"}
    named_by(
        session,
        "model",
        actions=words,
        action_model={**CARD, "labels": GENERATED},
        refused_bouts={"bouts": [refusal]},
    )
    text = " ".join(methods(session))
    assert "by rule" not in text
    assert "were joined" not in text
    assert "sha256 33f6ffbae33a3539" in text
    assert "learned from 32 recordings of virtual animals only" in text
    assert "semi-Markov chain" in text
    assert "1 bout that contradicted them has another name or none" in text
    assert ("1.00", "1.50", "pause", "unlabelled", "too fast") in refusal_rows(session)


def test_no_vocabulary_is_a_sentence(session: Session) -> None:
    reason = "No actions are named: no vocabulary was made for a snake."
    session.__dict__["bouts"] = session.bouts.iloc[:0]
    session.metadata.update(actions={}, no_actions=reason)
    assert reason in " ".join(methods(session))


def test_speed_is_said_of_the_joints_it_is_of(session: Session) -> None:
    joints = session.metadata["animal"]["joints"]
    assert f"mean of {', '.join(joints[:-1])} over the floor" in " ".join(methods(session))
    session.metadata["animal"]["joints"] = ["head", *(f"s{k}" for k in range(1, 21))]
    text = " ".join(methods(session))
    assert "the first 11 joints of the chain, head to s10, in space" in text
    assert "nose" not in text.split("Speed is")[1].split(".")[0]


def test_the_animal_has_one_length_on_a_page(session: Session) -> None:
    spine = float(session.summary["spine_mm"].iloc[0])
    assert f"chain is {spine:.1f} mm" in methods(session)[0]
    assert np.isclose(spine, session.frames["spine_mm"].median())
