"""What the animal did: measures per frame, bouts and a summary. Pandas in, pandas out."""

from liex_lab.behaviour.bouts import MouseRules, find_bouts
from liex_lab.behaviour.columns import ACTIONS, COLUMNS
from liex_lab.behaviour.kinematics import kinematics
from liex_lab.behaviour.summary import Behaviour, measure, summarise

__all__ = ["ACTIONS", "COLUMNS", "Behaviour", "MouseRules", "find_bouts", "kinematics", "measure", "summarise"]
