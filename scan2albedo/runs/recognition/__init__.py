"""Files of the `identify` command."""
