"""The simulated hand: its pose prior, its gestures, and its scene."""
