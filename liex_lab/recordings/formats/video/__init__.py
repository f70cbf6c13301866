"""Depth in video containers: AVI and Matroska with FFV1 or uncompressed 16-bit grey pictures."""
