"""Readers and writers of depth formats, by family; selected by `recordings.open`."""
