"""Running on a machine: memory and memory-mapped arrays, threads, prefetching, progress."""
