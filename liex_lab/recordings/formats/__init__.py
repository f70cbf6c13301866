"""Readers and writers of depth formats, one package to a family; `recordings.open` chooses."""
