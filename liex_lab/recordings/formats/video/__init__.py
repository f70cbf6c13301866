"""Depth in video containers: AVI and Matroska, FFV1 and raw pictures."""
