"""`python -m scan2albedo`: the command line."""

from scan2albedo.cli.commands import main

if __name__ == "__main__":
    main()
