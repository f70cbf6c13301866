"""Figures as files, drawn with matplotlib in one style, of a session, a study or a comparison."""
