"""Small meshes: vertices and faces as arrays, and scans of them."""

import numpy as np
import trimesh

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.oriented_points import oriented_points


def sphere(level, radius=90.0, center=(0.0, 0.0, 0.0)):
    """Return vertices (V, 3) and faces (F, 3) of an icosphere divided `level` times, seen from outside."""
    mesh = trimesh.creation.icosphere(level, radius)
    return np.asarray(mesh.vertices) + center, np.asarray(mesh.faces)


def grid(columns, rows):
    """Return vertices (V, 3), row by row over [0, 1]^2 in the plane z = 0, and faces that look along +z."""
    x, y = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([first, first + 1, first + columns + 1], 1)
    upper = np.stack([first, first + columns + 1, first + columns], 1)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), np.concatenate([lower, upper])


def bumpy_samples():
    """Return samples, 4 mm apart, of an asymmetric closed shape of 70 mm radius: its pose is unique."""
    unit, faces = sphere(5, 1.0)
    axes = np.array([[0, 0, 1.0], [0.6, 0.8, 0], [-0.8, 0, 0.6]])
    radius = 70 * (1 + np.exp(6 * (unit @ axes.T - 1)) @ [0.35, 0.25, 0.2])
    return oriented_points(unit * radius[:, None], faces, 4.0)


def ball(level=2, radius=90.0, name="ball"):
    """Return a scan of a sphere whose linear colours follow its coordinates: an object, no face."""
    vertices, faces = sphere(level, radius)
    color = np.clip(0.5 + vertices / (2.2 * radius), 0, 1)
    return RawScan(vertices, faces, vertex_color_linear=color, name=name)


def write_ball(path, level=2, radius=90.0):
    """Write a ball as a file with 8-bit vertex colours, in the format of its extension; return the path."""
    mesh = trimesh.creation.icosphere(level, radius)
    mesh.visual.vertex_colors = np.clip(128 + 90 / radius * mesh.vertices, 0, 255).astype(np.uint8)
    mesh.export(path)
    return path


def obj_text(vertices, faces=(), uv=None):
    """Return the lines of an OBJ file: vertices (V, 3), corners (V, 2) of the same indices, faces (F, 3)."""
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices]
    lines += [] if uv is None else [f"vt {u:.17g} {v:.17g}" for u, v in uv]
    corner = "{0}" if uv is None else "{0}/{0}"
    lines += ["f " + " ".join(corner.format(index + 1) for index in face) for face in faces]
    return "\n".join(lines) + "\n"
