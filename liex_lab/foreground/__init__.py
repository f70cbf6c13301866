"""Segmenter segmentation of depth pictures: which pixels are the animal, and its height map.

Background subtraction for an animal in an arena, geodesic extrema for a hand; connected components,
image moments, and the crop cameras by which later stages find pixels again.
"""
