"""The virtual hand: its postures, its gestures, the scene around it."""
