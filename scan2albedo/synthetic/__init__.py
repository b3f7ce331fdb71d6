"""Synthetic scenes with ground truth."""

from scan2albedo.synthetic.glasses import GlassesBend, GlassesShape, SyntheticEyeglasses, eyeglasses
from scan2albedo.synthetic.glossy_person import GlossyFace, population_reflectance
from scan2albedo.synthetic.portraits import FacePhotograph, FlashCapture, face_photograph, flash_capture
from scan2albedo.synthetic.raw_scan import Scanner, SyntheticTruth, raw_scan
from scan2albedo.synthetic.renderer import Material, Portrait
from scan2albedo.synthetic.scenes import (
    SyntheticScene,
    TextureName,
    face,
    hemisphere,
    light_at,
    with_normal_error,
)
from scan2albedo.synthetic.wearer import Wearer, wearer

__all__ = [
    "FacePhotograph",
    "FlashCapture",
    "GlassesBend",
    "GlassesShape",
    "GlossyFace",
    "Material",
    "Portrait",
    "Scanner",
    "SyntheticEyeglasses",
    "SyntheticScene",
    "SyntheticTruth",
    "TextureName",
    "Wearer",
    "eyeglasses",
    "face",
    "face_photograph",
    "flash_capture",
    "hemisphere",
    "light_at",
    "population_reflectance",
    "raw_scan",
    "wearer",
    "with_normal_error",
]
