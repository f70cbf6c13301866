"""MoSeq sessions (raw depth.dat, depth video or archive) with metadata; Azure Kinect files."""
