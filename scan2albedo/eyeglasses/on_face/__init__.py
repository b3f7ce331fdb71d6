"""A frame registered on a face."""
