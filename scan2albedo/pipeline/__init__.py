"""`process`: a raw scan through every stage it needs, and the files of the result."""
