"""Reproduction of Tables 1 to 3 and Figures 7 and 13 to 16 of Lie-X: `liex evaluate tables`."""
