"""Behaviour of one animal: kinematics, bouts, zones and summary; statistics of groups of animals.

Input and output are pandas tables.
"""

from liex_lab.behaviour.activity import Surroundings
from liex_lab.behaviour.bouts import ACTIONS, MouseRules, find_bouts, measure_bouts
from liex_lab.behaviour.kinematics import kinematics
from liex_lab.behaviour.summary import Behaviour, measure, measure_rows, measure_session, summarise

__all__ = [
    "ACTIONS",
    "Behaviour",
    "MouseRules",
    "Surroundings",
    "find_bouts",
    "kinematics",
    "measure",
    "measure_bouts",
    "measure_rows",
    "measure_session",
    "summarise",
]
