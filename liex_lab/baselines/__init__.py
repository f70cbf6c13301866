"""What the paper compares itself with: its regression forest, its CNN, and the method without one
of its parts.
"""
