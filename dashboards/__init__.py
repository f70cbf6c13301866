"""The views: they read session folders and compute no science."""
