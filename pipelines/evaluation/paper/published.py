"""Names of the rows, and the numbers that Lie-X publishes in its Tables 1 to 3."""

from __future__ import annotations

TITLES = {
    "default": "liex_lab (default)",
    "paper": "Lie-X, the paper's variant",
    "paper-one-pose": "Lie-X without multiple initial poses",
    "paper-no-metric": "Lie-X without the learned metric",
    "rf": "RF",
    "cnn": "CNN",
}
# Lie-X, Tables 1 and 2: mean joint error, real recordings, another camera and other animals
PUBLISHED_MM = {
    "fish": {
        "paper": 0.68,
        "paper-one-pose": 3.28,
        "paper-no-metric": 1.71,
        "rf": 1.28,
        "cnn": 0.79,
    },
    "mouse": {
        "paper": 6.64,
        "paper-one-pose": 13.27,
        "paper-no-metric": 9.82,
        "rf": 12.24,
        "cnn": 9.17,
    },
    "hand": {
        "paper": 14.51,
        "paper-one-pose": 20.50,
        "paper-no-metric": 16.72,
        "rf": 24.81,
        "cnn": 18.82,
    },
}
OTHERS_MM = {
    "Tompson et al.": 21.0,
    "Oberweger et al. (a)": 20.0,
    "Oberweger et al. (b)": 16.5,
    "Zhou et al.": 16.9,
}
PUBLISHED_FPS = {"fish": 83.0, "mouse": 267.0, "hand": 123.0}
OTHERS_FPS = {
    "Tompson et al.": 30,
    "Oberweger et al. (a)": 5000,
    "Oberweger et al. (b)": 400,
    "Zhou et al.": 125,
}
