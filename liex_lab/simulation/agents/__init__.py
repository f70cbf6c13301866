"""Virtual animals with labelled behaviour, rendered frame by frame."""
