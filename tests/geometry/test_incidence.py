"""Lists of neighbours and faces against plain sets."""

import itertools

import numpy as np
import pytest

from scan2albedo.geometry.incidence import face_lists, neighbour_lists


def rows(begins, values):
    return [values[a:b].tolist() for a, b in itertools.pairwise(begins)]


def fan(count):
    """Faces around vertex 0, in random order: far more neighbours than a vertex usually has."""
    rim = np.random.default_rng(0).permutation(np.arange(1, count))
    return np.stack([np.zeros(count - 1, int), rim, np.roll(rim, 1)], 1)


@pytest.mark.parametrize(
    "faces",
    [
        np.zeros((0, 3), int),
        np.array([[0, 1, 2], [2, 1, 3], [0, 1, 2]]),
        np.array([[4, 4, 4], [1, 1, 3]]),
        np.random.default_rng(1).integers(0, 12, (60, 3)),
        fan(12),
        fan(500),
    ],
    ids=["none", "twice the same", "degenerate", "random", "fan", "large fan"],
)
def test_lists_are_those_of_plain_sets(faces):
    count = max(12, int(faces.max(initial=0)) + 1)
    joined, around = [set() for _ in range(count)], [[] for _ in range(count)]
    for number, face in enumerate(faces.tolist()):
        for k in range(3):
            around[face[k]].append(number)
            joined[face[k]] |= set(face) - {face[k]}
    assert rows(*neighbour_lists(count, faces)) == [sorted(one) for one in joined]
    assert rows(*face_lists(count, faces)) == around


@pytest.mark.parametrize("wrong", [-1, 5])
def test_faces_of_no_vertex_are_refused(wrong):
    for lists in (neighbour_lists, face_lists):
        with pytest.raises(IndexError, match="faces refer to vertices"):
            lists(5, np.array([[0, 1, wrong]]))
