"""What the animal stands in: the floor plane, the outline of the walls, zones that people drew."""
