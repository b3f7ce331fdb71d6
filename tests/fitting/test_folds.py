import numpy as np
from helpers.measures import row_lengths

from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.stages import FoldFinder, guarded, turned_faces
from scan2albedo.geometry.mesh import face_normals, vertex_normals


def test_compiled_normals_are_the_plain_ones(mask_model):
    points, faces = mask_model.surface(1)
    vertex, face = surface_normals(points, faces)
    np.testing.assert_allclose(vertex, vertex_normals(points, faces), atol=1e-12)
    np.testing.assert_allclose(face, face_normals(points, faces), atol=1e-12)


def test_a_step_that_would_turn_a_triangle_is_shortened_there_only(mask_model):
    samples = SurfaceSamples.of(mask_model, mask_model.control_vertices, 1)
    before, faces = mask_model.control_vertices, mask_model.control_faces
    normals = surface_normals(samples.matrix @ before, samples.faces)[1]
    harmless = before * 1.1
    np.testing.assert_array_equal(guarded(before, harmless, normals, samples, faces), harmless)
    after = before + [0.0, 0.0, 1.0]
    centre = np.argmin(row_lengths(before[:, :2]))
    after[centre, 0] += 40.0
    assert len(turned_faces(normals, samples.matrix @ after, samples.faces, 0.2))
    safe = guarded(before, after, normals, samples, faces)
    assert not len(turned_faces(normals, samples.matrix @ safe, samples.faces, 0.2))
    whole = np.isclose(safe, after).all(1)
    assert whole.mean() > 0.8
    assert not whole[centre]


def test_the_fold_finder_finds_a_vertex_pulled_through_its_neighbours(mask_model):
    rest, faces = mask_model.surface(1)
    assert len(FoldFinder(rest, faces).find(rest)) == 0
    pulled = rest.copy()
    pulled[np.argmin(row_lengths(rest[:, :2] - [30, 30])), 0] += 25
    assert len(FoldFinder(rest, faces).find(pulled)) > 0
