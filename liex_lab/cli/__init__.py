"""The command line, `liex`."""

from liex_lab.cli.main import FAULT, app, main

__all__ = ["FAULT", "app", "main"]
