"""Folders of depth pictures and point clouds: PNG, TIFF, PGM, PCLZF, Raytrix exports, the NYU hand
data set.
"""
