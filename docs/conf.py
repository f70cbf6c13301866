"""Sphinx: `python -m sphinx -W docs OUT` builds the site, without a network.

The examples of docs/examples are run, and their figures are those of this build.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
os.environ.setdefault("MPLBACKEND", "agg")

import liex_lab  # noqa: E402

project = "liex_lab"
author = "the authors of liex_lab"
copyright = "the authors of liex_lab, BSD-3-Clause"
release = liex_lab.__version__
version = release
language = "en"

extensions = [
    "myst_parser",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "examples", "**/GALLERY_HEADER.md"]
suppress_warnings = ["config.cache"]
myst_heading_anchors = 3
nitpicky = False

html_theme = "pydata_sphinx_theme"
html_title = "liex_lab"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 8,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_prev_next": True,
}
html_sidebars = {"index": [], "faq": [], "evidence": []}

# what the examples measure is measured once, by the first of them, and read by the others
shutil.rmtree(HERE / "examples" / "results", ignore_errors=True)
warnings.filterwarnings("ignore", message=".*non-interactive.*")
sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"plot_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "image_scrapers": ("matplotlib",),
    "reset_modules": ("matplotlib",),
}

# Pages are plain Markdown, read where the repository is read, too. In the site a link to an example
# leads to its page in the gallery, and the links of an index page are the site's contents.
_EXAMPLE = re.compile(r"\]\((?:\.\./)*examples/(plot_\w+)\.py\)")
_ENTRY = re.compile(r"^(?:- |\| )\[[^\]]*\]\(([^)]+)\.(?:md|rst)\)", re.MULTILINE)


def fit_to_site(app: Any, docname: str, source: list[str]) -> None:
    """Turn links to examples into links to the gallery, and add an index page's contents.

    Args:
        app: Sphinx.
        docname: the page.
        source: its text, the only element, changed in place.
    """
    text = _EXAMPLE.sub(r"](/auto_examples/\1.rst)", source[0])
    if docname.endswith("index") and not docname.startswith("auto_examples"):
        text = text.replace("](examples)", "](/auto_examples/index.rst)")
        entries = "\n".join(_ENTRY.findall(text))
        text += f"\n```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
    source[0] = text


def setup(app: Any) -> None:
    """Register with Sphinx.

    Args:
        app: Sphinx.
    """
    app.connect("source-read", fit_to_site)
