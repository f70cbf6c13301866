"""Jobs of liex_lab: what each command does, in which order, on which files, with how many workers.

The algorithms are in the library. Installed as `liex_lab.pipelines`.
"""
