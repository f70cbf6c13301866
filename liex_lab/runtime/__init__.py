"""How a job behaves on a machine: its memory, its threads, and what it says while it works."""
