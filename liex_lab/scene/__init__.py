"""The scene before the camera, and the animals in it.

Floor, walls, region and zones of the arena; the empty background; the segmentation of each depth
image into animals and everything else, with a height map of each animal.
"""
