"""Each system's own runs and their files, for its commands: the command line alone imports them."""
