"""From poses to a track: the curve of one animal over a recording."""
