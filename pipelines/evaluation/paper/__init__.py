"""Tables 1 to 3 and Figures 7, 8 and 13 to 16 of Lie-X made anew: `liex evaluate tables`."""
