"""Virtual animals that act: sequences of labelled behaviour, rendered frame by frame."""
