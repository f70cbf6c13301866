"""Readers and writers of depth formats, by family; `recordings.open` chooses among them."""
