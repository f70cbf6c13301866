"""Figures of the Lie-X paper, drawn from the evaluation's results."""
