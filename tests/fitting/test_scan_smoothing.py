import numpy as np
import pytest
from helpers.face_mask import mask_surface
from helpers.measures import row_lengths
from helpers.meshes import grid

from scan2albedo.fitting.scan_surface import smoothed
from scan2albedo.geometry.mesh import boundary_vertex_mask, neighbour_lists


def smoothed_alone(vertices, faces, border, scale_mm, **options):
    """As `smoothed`, each vertex a measurement."""
    once, joined = np.ones(len(vertices)), neighbour_lists(len(vertices), faces)
    return smoothed(vertices, faces, border, once, joined, scale_mm, **options)


def noisy_plane(size, noise_mm):
    vertices, faces = mask_surface(size)
    vertices[:, 2] = np.random.default_rng(0).normal(scale=noise_mm, size=len(vertices))
    return vertices, faces, boundary_vertex_mask(len(vertices), faces)


def test_a_coarse_scan_stays_as_it_is():
    vertices, faces, border = noisy_plane(41, 0.3)
    np.testing.assert_array_equal(smoothed_alone(vertices, faces, border, 0.8), vertices)


@pytest.mark.parametrize(("keep_curvature", "left_mm"), [(False, 0.13), (True, 0.17)])
def test_noise_of_a_fine_scan_averages_out(keep_curvature, left_mm):
    vertices, faces, border = noisy_plane(161, 0.3)
    fair = smoothed_alone(vertices, faces, border, 2.0, keep_curvature=keep_curvature)
    assert fair[~border, 2].std() < left_mm
    np.testing.assert_array_equal(fair[border], vertices[border])


def test_a_spike_has_no_say_and_is_drawn_in():
    vertices, faces, border = noisy_plane(161, 0.1)
    spike = int(np.argmin(row_lengths(vertices[:, :2])))
    vertices[spike, 2] = 20.0
    fair = smoothed_alone(vertices, faces, border, 2.0)
    assert np.abs(fair[~border, 2]).max() < 0.4


@pytest.mark.parametrize("radius", [80.0, 200.0])
def test_curvature_loses_no_more_than_theory_says(radius):
    vertices, faces, border = noisy_plane(161, 0.0)
    square = (vertices[:, :2] ** 2).sum(1)
    vertices[:, 2] = -square / (2 * radius)
    fair = smoothed_alone(vertices, faces, border, 1.0)
    assert np.abs(fair - vertices)[square < 30**2, 2].max() < 1.5 * 1.0**2 / radius


@pytest.mark.parametrize("radius", [10.0, 30.0])
def test_curvature_stays_when_asked(radius):
    vertices, faces, border = noisy_plane(161, 0.0)
    square = (vertices[:, :2] ** 2).sum(1)
    vertices[:, 2] = np.sqrt(np.maximum(radius**2 - square, 0))
    cap = square < (0.4 * radius) ** 2
    lost, kept = (
        np.abs(smoothed_alone(vertices, faces, border, 1.5, keep_curvature=keep) - vertices)[cap, 2].max()
        for keep in (False, True)
    )
    assert kept < 0.25 * lost


def test_a_mesh_of_uneven_density_does_not_shrink():
    flat, faces = grid(121, 121)
    dome = 45 * (2 * flat - 1) ** 3
    dome[:, 2] = np.sqrt(80**2 - (dome[:, :2] ** 2).sum(1))
    fair = smoothed_alone(dome, faces, boundary_vertex_mask(len(dome), faces), 0.8)
    assert np.abs(row_lengths(fair) - 80).max() < 3 * 0.8**2 / 80
