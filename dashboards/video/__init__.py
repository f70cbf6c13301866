"""Videos for people: depth as relief with skeleton, trail, action and time; clips beside clips."""
