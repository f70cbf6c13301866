"""The simulated hand: its pose prior, its gestures, the scene around it."""
