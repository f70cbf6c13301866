"""Jobs of `liex evaluate`: one benchmark a module, each with its protocol and numbers."""
