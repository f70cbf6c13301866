"""The jobs: in which order, on which files, with how many workers. Installed as
`liex_lab.pipelines`.
"""
