"""Scenes in front of a lab's depth camera, with exact truth; `catalogue` lists them by name."""
