"""Synthetic scenes with ground truth."""

from scan2albedo.synthetic.raw_like import RawLikeOptions, raw_like
from scan2albedo.synthetic.raw_scan import RawScanOptions, SyntheticTruth, raw_scan
from scan2albedo.synthetic.renderer import Material
from scan2albedo.synthetic.scenes import (
    SceneParameters,
    SyntheticScene,
    TextureName,
    face,
    hemisphere,
    light_at,
    with_normal_error,
)

__all__ = [
    "Material",
    "RawLikeOptions",
    "RawScanOptions",
    "SceneParameters",
    "SyntheticScene",
    "SyntheticTruth",
    "TextureName",
    "face",
    "hemisphere",
    "light_at",
    "raw_like",
    "raw_scan",
    "with_normal_error",
]
