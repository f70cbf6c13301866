"""Virtual animals that act: sequences of named behaviour, rendered frame by frame."""
