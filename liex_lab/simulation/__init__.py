"""Simulated depth recordings with exact truth: bodies, poses, sensors, scenes, corruptions."""
