"""One room for each family of files; `recordings.open` knows which one reads what."""
