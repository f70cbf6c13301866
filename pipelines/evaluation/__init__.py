"""The jobs of `liex evaluate`: one benchmark a module."""
