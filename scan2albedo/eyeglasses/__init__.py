"""Eyeglasses, after the supplement of Li et al., "MEGANE: Morphable Eyeglass and Avatar Network", CVPR 2023.

S2: `canonicalization`, with `weights` and `skinning`. S3, registration on the face: `on_face`. S11 to S15:
`lenses`. Files: `frame_files`, `view_files`.
"""

from scan2albedo.eyeglasses.canonicalization import (
    CanonicalEyeglasses,
    CanonicalizationOptions,
    CanonicalSet,
    canonicalize,
)
from scan2albedo.eyeglasses.frame_files import (
    read_canonical,
    read_keypoints,
    read_registered,
    read_start,
    write_canonical,
    write_keypoints,
    write_registered,
    write_start,
)
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, SKELETON
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.lens_picture import LensPicture, LensPictureOptions, insert_lenses
from scan2albedo.eyeglasses.lenses.optics import LensMaterial, RefractedRays, ThinLens, refract
from scan2albedo.eyeglasses.lenses.rims import LensRim, find_lens_rim, refine_lens_rim
from scan2albedo.eyeglasses.lenses.scenes import Surface
from scan2albedo.eyeglasses.on_face.inputs import FaceRegistrationOptions, RegisteredEyeglasses
from scan2albedo.eyeglasses.on_face.registration import register_on_face
from scan2albedo.eyeglasses.on_face.start_poses import TriangulatedPoints, triangulate
from scan2albedo.eyeglasses.proposed_keypoints import ProposedKeyPoints, propose_keypoints
from scan2albedo.eyeglasses.skinning import skin
from scan2albedo.eyeglasses.view_files import (
    Camera,
    ViewLabels,
    read_cameras,
    read_labels,
    read_masks,
    write_cameras,
    write_labels,
    write_masks,
)
from scan2albedo.eyeglasses.weights import BoundedBiharmonicWeights, bounded_biharmonic_weights, solve_weights
from scan2albedo.lighting.environment import DistantLights, distant_directions, environment_weights

__all__ = [
    "KEY_POINT_NAMES",
    "SKELETON",
    "BoundedBiharmonicWeights",
    "Camera",
    "CanonicalEyeglasses",
    "CanonicalSet",
    "CanonicalizationOptions",
    "DistantLights",
    "FaceRegistrationOptions",
    "InsertedLens",
    "LensMaterial",
    "LensPicture",
    "LensPictureOptions",
    "LensRim",
    "ProposedKeyPoints",
    "RefractedRays",
    "RegisteredEyeglasses",
    "Surface",
    "ThinLens",
    "TriangulatedPoints",
    "ViewLabels",
    "bounded_biharmonic_weights",
    "canonicalize",
    "distant_directions",
    "environment_weights",
    "find_lens_rim",
    "insert_lenses",
    "propose_keypoints",
    "read_cameras",
    "read_canonical",
    "read_keypoints",
    "read_labels",
    "read_masks",
    "read_registered",
    "read_start",
    "refine_lens_rim",
    "refract",
    "register_on_face",
    "skin",
    "solve_weights",
    "triangulate",
    "write_cameras",
    "write_canonical",
    "write_keypoints",
    "write_labels",
    "write_masks",
    "write_registered",
    "write_start",
]
