"""`liex dashboard`: a study's pages in the browser (Dash and plotly)."""
