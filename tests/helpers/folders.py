"""What is in a folder, to compare before and after."""

import os


def contents(folder):
    """Return what is in a folder, by paths in it: the bytes of a file, the target of a link, or None."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = path.read_bytes() if path.is_file() else None
    return found
