"""Plan of a run (all settings of one session) and study file (many sessions), both TOML."""

from liex_lab.plan.plan import Plan, known_plans, plans_folder

__all__ = ["Plan", "known_plans", "plans_folder"]
