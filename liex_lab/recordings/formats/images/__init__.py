"""Folders of depth images and point clouds.

PNG, TIFF, PGM, PCLZF, exports of Raytrix cameras, and the NYU hand pose data set.
"""
