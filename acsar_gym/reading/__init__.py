"""Reading files of strangers: bounded in size and depth."""
