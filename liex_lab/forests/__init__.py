"""Random regression forests on pose-indexed depth features (Lie-X section 4.4)."""
