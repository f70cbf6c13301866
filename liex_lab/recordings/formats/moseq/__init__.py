"""MoSeq sessions: raw, video or archive, with their metadata; Azure Kinect's own files."""
