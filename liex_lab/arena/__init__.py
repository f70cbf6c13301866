"""What the animal stands in: the floor's plane, the outline of the walls, zones that people
drew.
"""
