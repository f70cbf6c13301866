"""Entry point of `python -m liex_lab`, which is the command `liex`."""

from liex_lab.cli import main

if __name__ == "__main__":
    main()
