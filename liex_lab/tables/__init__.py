"""Tables of a session: the schema of every column, and the rows that a track fills them with."""
