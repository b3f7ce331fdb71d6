"""Eyeglasses: weights that tie a frame to its key points, and the deformations they carry."""

from scan2albedo.eyeglasses.canonicalization import (
    CanonicalEyeglasses,
    CanonicalizationOptions,
    CanonicalSet,
    canonicalize,
)
from scan2albedo.eyeglasses.keypoint_files import read_keypoints, write_keypoints
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, SKELETON
from scan2albedo.eyeglasses.options import WeightOptions
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
    "TriangulatedPoints",
    "WeightOptions",
    "bounded_biharmonic_weights",
    "canonicalize",
    "read_keypoints",
    "skin",
    "solve_weights",
    "triangulate",
    "write_keypoints",
]
