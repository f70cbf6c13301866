"""Training jobs of `liex train`: pose models, motion models, action models, baselines."""
