"""Figures of the Lie-X paper, drawn from what the evaluation measured."""
