"""Everything a run depends on: the plan of a session, and the study that holds many."""

from liex_lab.plan.plan import Plan, known_plans, plans_folder

__all__ = ["Plan", "known_plans", "plans_folder"]
