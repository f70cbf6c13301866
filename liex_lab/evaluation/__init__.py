"""Scores of poses and tracks against truth, and the NYU hand protocol."""
