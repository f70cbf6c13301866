"""Jobs of `liex cohort`: a study's sessions, on this machine, on Dask or on Slurm."""
