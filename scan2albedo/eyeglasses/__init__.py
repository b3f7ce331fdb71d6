"""Eyeglasses: weights that tie a frame to its key points, and the deformations they carry."""

from scan2albedo.eyeglasses.keypoint_files import read_keypoints, write_keypoints
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, SKELETON
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
    "RefractedRays",
    "ThinLens",
    "TriangulatedPoints",
    "WeightOptions",
    "bounded_biharmonic_weights",
    "read_keypoints",
    "refract",
    "skin",
    "solve_weights",
    "triangulate",
    "write_keypoints",
]
