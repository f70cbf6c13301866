"""Videos: depth as relief with skeleton, trail, action and time; grids of clips."""
