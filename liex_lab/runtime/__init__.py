"""Runtime support: memory, memory-mapped arrays, threads, prefetching, progress, durable files."""
