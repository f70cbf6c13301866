"""`python -m liex_lab` is `liex`."""

from liex_lab.cli import main

if __name__ == "__main__":
    main()
