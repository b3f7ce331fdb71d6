"""Synthetic scenes with ground truth."""

from scan2albedo.synthetic.camera import PortraitOptions
from scan2albedo.synthetic.face_photograph import FacePhotograph, FacePhotographOptions, face_photograph
from scan2albedo.synthetic.flash_capture import FlashCapture, FlashCaptureOptions, flash_capture
from scan2albedo.synthetic.glasses import SyntheticEyeglasses, eyeglasses
from scan2albedo.synthetic.glasses_shape import GlassesBend, GlassesShape
from scan2albedo.synthetic.glossy_person import GlossyFace
from scan2albedo.synthetic.population import PopulationOptions, population_reflectance, population_scan
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
from scan2albedo.synthetic.stereo_scan import StereoScanOptions, StereoTruth, stereo_scan, stereo_scan_of
from scan2albedo.synthetic.wearer import Wearer, WearerOptions, wearer

__all__ = [
    "FacePhotograph",
    "FacePhotographOptions",
    "FlashCapture",
    "FlashCaptureOptions",
    "GlassesBend",
    "GlassesShape",
    "GlossyFace",
    "Material",
    "PopulationOptions",
    "PortraitOptions",
    "RawLikeOptions",
    "RawScanOptions",
    "SceneParameters",
    "StereoScanOptions",
    "StereoTruth",
    "SyntheticEyeglasses",
    "SyntheticScene",
    "SyntheticTruth",
    "TextureName",
    "Wearer",
    "WearerOptions",
    "eyeglasses",
    "face",
    "face_photograph",
    "flash_capture",
    "hemisphere",
    "light_at",
    "population_reflectance",
    "population_scan",
    "raw_like",
    "raw_scan",
    "stereo_scan",
    "stereo_scan_of",
    "wearer",
    "with_normal_error",
]
