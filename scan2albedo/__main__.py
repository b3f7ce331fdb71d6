"""`python -m scan2albedo`: the command line."""

from scan2albedo.cli import main

if __name__ == "__main__":
    main()
