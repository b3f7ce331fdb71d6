"""Frames as tests pose and glaze them; distances to outlines; what lenses do to rays, by another way."""

import numpy as np

from scan2albedo.eyeglasses.lenses.inserted_lenses import lens_mesh
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.rasterization import polyline_distance
from scan2albedo.geometry.rigid import compose, random_rotation, transform_points


def volume(vertices, faces):
    """Volume that a closed mesh encloses."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def posed(points, seed):
    """Points turned and shifted at random."""
    rng = np.random.default_rng(seed)
    return transform_points(compose(random_rotation(rng), rng.normal(0, 200, 3)), points)


def outline_distances(points, outline):
    """Distance (P,) of each point to a closed polygon (S, 3) in space."""
    return polyline_distance(points, np.concatenate([outline, outline[:1]]))


def glazed(glasses, sides=(0, 1), gap=0.3):
    """A frame with glass in its rims: two domed sheets a lens, `gap` inside the outline."""
    parts = [(glasses.vertices, glasses.faces)]
    for side in sides:
        outline, center = glasses.lens_outlines[side], glasses.lens_centers[side]
        inward = (center - outline) / np.linalg.norm(center - outline, axis=1)[:, None]
        for lift in (0.0, -2.0):
            parts.append(lens_mesh(center + [0, 0, 3 + lift], outline + gap * inward + [0, 0, lift]))
    return join(parts)


def conjugate_directions(camera, points, center, axis, dioptres):
    """Rays from points (N, 3) of a lens toward the image of the camera, by 1/u + 1/v = 1/f."""
    u = (camera - center) @ axis
    v = 1 / (dioptres / 1000 - 1 / u)
    image = center - (camera - center) * v / u  # the chief ray is straight
    return np.sign(v) * (image - points)


def angle_deg(a, b):
    """Angles between rows; exact for small ones, where arccos is not."""
    a, b = (v / np.linalg.norm(v, axis=1)[:, None] for v in (a, b))
    return np.rad2deg(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def nearest_weights(vertices, keypoints):
    """Weights (V, 20) that give each vertex to its nearest key point, in place of solved ones."""
    return np.eye(20)[np.linalg.norm(vertices[:, None] - keypoints, axis=2).argmin(1)]
