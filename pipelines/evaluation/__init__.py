"""Jobs of `liex evaluate`: one benchmark per module, each with its protocol and numbers."""
