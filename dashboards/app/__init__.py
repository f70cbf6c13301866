"""`liex dashboard`: a study's pages in the browser."""
