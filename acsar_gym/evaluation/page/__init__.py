"""HTML reports of text, tables, plots and pictures, each one self-contained file."""
