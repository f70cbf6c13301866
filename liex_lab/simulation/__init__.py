"""Virtual recordings with truth: bodies, postures, sensors, scenes and what goes wrong in them."""
