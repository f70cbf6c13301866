"""The columns of every table of a session, and the rows that a track fills them with."""
