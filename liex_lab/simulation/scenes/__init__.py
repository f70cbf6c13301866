"""Scenes that stand before a lab's depth camera, with exact truth: `catalogue` has them by name."""
