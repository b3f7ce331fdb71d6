"""Models as .npz files: that they come back whole, and files that someone changed."""

from dataclasses import fields

import numpy as np


def assert_comes_back(model, folder):
    """Save a model twice and read it: every field is the same, and so are the bytes of both files."""
    model.save(folder / "a.npz")
    model.save(folder / "b.npz")
    back = type(model).load(folder / "a.npz")
    for one in fields(model):
        np.testing.assert_array_equal(getattr(back, one.name), getattr(model, one.name))
    assert (folder / "a.npz").read_bytes() == (folder / "b.npz").read_bytes()


def rewritten(path, **changes):
    """Replace arrays of a file; None leaves one out."""
    with np.load(path) as file:
        arrays = dict(file) | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def cut(path):
    """Leave the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
