"""The views (dashboard, report, replays, figures): they read sessions and compute no science."""
