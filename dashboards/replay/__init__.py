"""Layouts of the replays: Rerun's blueprint and Foxglove's layout."""
