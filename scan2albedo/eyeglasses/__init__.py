"""Eyeglasses: weights that tie a frame to its key points, canonical frames, and lenses."""

from scan2albedo.eyeglasses.canonicalization import (
    CanonicalEyeglasses,
    CanonicalizationOptions,
    CanonicalSet,
    canonicalize,
)
from scan2albedo.eyeglasses.environment_lights import (
    DistantLights,
    distant_directions,
    environment_weights,
)
from scan2albedo.eyeglasses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.keypoint_files import read_keypoints, write_keypoints
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, SKELETON
from scan2albedo.eyeglasses.lens_material import LensMaterial, LensPictureOptions
from scan2albedo.eyeglasses.lens_mesh import lens_mesh
from scan2albedo.eyeglasses.lens_picture import LensPicture, insert_lenses
from scan2albedo.eyeglasses.lens_rims import LensRim, find_lens_rim
from scan2albedo.eyeglasses.lens_scene import Surface
from scan2albedo.eyeglasses.lens_shading import (
    blend_lens,
    environment_radiance,
    light_by_environment,
    mirror_on_sphere,
)
from scan2albedo.eyeglasses.options import WeightOptions
from scan2albedo.eyeglasses.refraction import RefractedRays, ThinLens, refract
from scan2albedo.eyeglasses.skinning import skin
from scan2albedo.eyeglasses.triangulation import TriangulatedPoints, triangulate
from scan2albedo.eyeglasses.weights import (
    BoundedBiharmonicWeights,
    bounded_biharmonic_weights,
    solve_weights,
)

__all__ = [
    "KEY_POINT_NAMES",
    "SKELETON",
    "BoundedBiharmonicWeights",
    "CanonicalEyeglasses",
    "CanonicalSet",
    "CanonicalizationOptions",
    "DistantLights",
    "InsertedLens",
    "LensMaterial",
    "LensPicture",
    "LensPictureOptions",
    "LensRim",
    "RefractedRays",
    "Surface",
    "ThinLens",
    "TriangulatedPoints",
    "WeightOptions",
    "blend_lens",
    "bounded_biharmonic_weights",
    "canonicalize",
    "distant_directions",
    "environment_radiance",
    "environment_weights",
    "find_lens_rim",
    "insert_lenses",
    "lens_mesh",
    "light_by_environment",
    "mirror_on_sphere",
    "read_keypoints",
    "refract",
    "skin",
    "solve_weights",
    "triangulate",
    "write_keypoints",
]
