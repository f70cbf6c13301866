"""What the animal did: measures per frame, bouts, places and sums, and groups compared. Pandas in,
pandas out.
"""

from liex_lab.behaviour.bouts import ACTIONS, MouseRules, find_bouts
from liex_lab.behaviour.kinematics import kinematics
from liex_lab.behaviour.measures import measure_bouts
from liex_lab.behaviour.places import Surroundings
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
