"""Regression forests on pose-indexed depth features (Lie-X section 4.4): what a tree is, and how it
is grown.
"""
