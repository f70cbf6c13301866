"""Figures as files: one style, drawn with matplotlib, of a session, of a study, of a comparison."""
