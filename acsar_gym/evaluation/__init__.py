"""Episodes, their metrics and reports."""
