"""Starting poses face outward and reach every part of a scan."""

import numpy as np
from helpers.meshes import sphere

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.oriented_points import anchors, oriented_points
from scan2albedo.registration.coarse_search import anchored_starts


def test_starts_on_a_sphere_face_outward_everywhere():
    samples = oriented_points(*sphere(4), 5.0)
    spread = anchors(samples, spacing=30.0, limit=600, reach=45.0)
    front = np.array([1.0, 2.0, 40.0])
    starts = anchored_starts(spread, front, 300)
    on_surface = np.einsum("nij,j->ni", starts.rotations, front) + starts.translations
    outward = normalized(on_surface)
    cosine = np.einsum("ni,ni->n", outward, starts.rotations[:, :, 2])
    assert np.degrees(np.arccos(cosine.min())) < 36.5
    directions = normalized(np.random.default_rng(0).normal(size=(200, 3)))
    assert np.degrees(np.arccos((directions @ outward.T).max(1).min())) < 25
    # Every anchor is tried at several roll angles.
    assert len(starts) > 10 * len(np.unique(on_surface.round(3), axis=0))
