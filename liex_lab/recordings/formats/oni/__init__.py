"""PrimeSense and OpenNI `.oni` recordings, read and written: records, index, 16z depth codec."""
