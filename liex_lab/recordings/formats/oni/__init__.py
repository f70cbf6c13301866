"""PrimeSense's `.oni`, read and written."""
