"""A textured mesh as one GLB file that any viewer opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.io.atomic import write_bytes

METRES_PER_MM = 1e-3


def write_glb(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike | None = None,
    texture_srgb: NDArray[np.uint8] | None = None,
    *,
    emissive: bool = False,
) -> None:
    """Write a mesh with its base colour as binary glTF 2.0, atomically.

    Parameters
    ----------
    path : str or Path
    vertices : (V, 3) array_like of float
        Millimetres; stored as metres, glTF's unit.
    faces : (F, 3) array_like of int
    uv : (V, 2) array_like of float, optional
        v = 0 is the bottom row of the texture (glTF counts from the top; it is turned here).
    texture_srgb : (H, W, 3) uint8, optional
        Base colour; grey when omitted.
    emissive : bool
        The texture shines by itself instead: light is in it already, and no viewer adds to it.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    ValueError
        For a texture without `uv`, or wrong shapes.
    """
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    points, triangles = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"vertices {points.shape} and faces {triangles.shape}, expected (V, 3) and (F, 3)")
    if texture_srgb is not None and uv is None:
        raise ValueError("a texture needs uv coordinates")
    if uv is not None and np.shape(uv) != (len(points), 2):
        raise ValueError(f"uv has shape {np.shape(uv)}, expected ({len(points)}, 2)")
    picture = None if texture_srgb is None else _pillow_image(texture_srgb)
    if emissive:
        color = {"emissiveTexture": picture, "emissiveFactor": [1.0, 1.0, 1.0]}
        color["baseColorFactor"] = [0, 0, 0, 255]
    else:
        white = [200, 200, 200, 255] if picture is None else [255, 255, 255, 255]
        color = {"baseColorTexture": picture, "baseColorFactor": white}
    material = PBRMaterial(name="albedo", metallicFactor=0.0, roughnessFactor=0.9, **color)
    coordinates = np.zeros((len(points), 2)) if uv is None else np.asarray(uv, np.float64)
    mesh = trimesh.Trimesh(
        points * METRES_PER_MM,
        triangles,
        visual=TextureVisuals(uv=coordinates, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(mesh, geom_name="face")
    write_bytes(path, scene.export(file_type="glb", include_normals=True))


def _pillow_image(texture_srgb: NDArray[np.uint8]):  # type: ignore[no-untyped-def]
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(texture_srgb, np.uint8))
    image.format = "PNG"
    return image
