"""Jobs of liex_lab: what each command does, in which order, on which files, with how many workers.

The library knows how; a job knows when and where. Installed as `liex_lab.pipelines`.
"""
