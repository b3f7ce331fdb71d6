"""Files of every kind that is read, and the damage that `tools/mutate_files.py` does to them."""
