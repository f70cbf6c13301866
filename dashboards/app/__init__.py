"""`liex dashboard`: a study's pages in the browser (Flask, Jinja and ES modules)."""
