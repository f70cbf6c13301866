"""Names, colours and lines of the methods in the figures of the paper."""

from __future__ import annotations

METHODS = {  # variant: (name in the legend, colour, line)
    "default": ("liex_lab", "#AA3377", "-"),
    "paper": ("Lie-X, the paper's variant", "#4477AA", "-"),
    "paper-one-pose": ("one initial pose", "#4477AA", ":"),
    "paper-no-metric": ("no learned metric", "#4477AA", "--"),
    "rf": ("RF", "#228833", "-"),
    "cnn": ("CNN", "#CCBB44", "-"),
}
TRUE = "#33AADD"
DPI = 130
