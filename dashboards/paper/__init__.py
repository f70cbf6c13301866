"""Figures of the paper, drawn from what the evaluation measured."""
