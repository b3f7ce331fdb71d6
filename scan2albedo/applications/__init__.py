"""What a processed face is for: other light, skin or expression; the scan itself, and templates, unlit."""

from typing import TYPE_CHECKING

from scan2albedo.core.lazy import loaded_when_asked

if TYPE_CHECKING:
    from scan2albedo.applications.blending import blend_faces
    from scan2albedo.applications.expression_transfer import (
        TransferOptions,
        personal_model,
        transfer_expression,
    )
    from scan2albedo.applications.face_reflectance import FaceReflectance, reflectance_of_processed
    from scan2albedo.applications.files import load_result, write_face
    from scan2albedo.applications.light_sweep import frames_srgb, light_arc, sweep, write_frames, write_gif
    from scan2albedo.applications.relighting import RelightOptions, RelitFace, default_camera, relight
    from scan2albedo.applications.texture_swap import SwapOptions, swap_texture
    from scan2albedo.rendering.pictures import Picture
    from scan2albedo.unlit.engine_maps import engine_maps
    from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth
    from scan2albedo.unlit.light_removal import UnlitScan, unlit_scan
    from scan2albedo.unlit.processed_face import Eyeball, EyesAndMouth, FaceMesh, ProcessedFace
    from scan2albedo.unlit.template_baking import TemplateTexture, TemplateTile, bake, template_texture

_HOMES = {
    "scan2albedo.applications.blending": ("blend_faces",),
    "scan2albedo.applications.expression_transfer": (
        "TransferOptions",
        "personal_model",
        "transfer_expression",
    ),
    "scan2albedo.applications.face_reflectance": (
        "FaceReflectance",
        "reflectance_of_processed",
    ),
    "scan2albedo.applications.files": (
        "load_result",
        "write_face",
    ),
    "scan2albedo.applications.light_sweep": (
        "frames_srgb",
        "light_arc",
        "sweep",
        "write_frames",
        "write_gif",
    ),
    "scan2albedo.applications.relighting": (
        "RelightOptions",
        "RelitFace",
        "default_camera",
        "relight",
    ),
    "scan2albedo.applications.texture_swap": (
        "SwapOptions",
        "swap_texture",
    ),
    "scan2albedo.rendering.pictures": ("Picture",),
    "scan2albedo.unlit.engine_maps": ("engine_maps",),
    "scan2albedo.unlit.eyes_and_mouth": ("eyes_and_mouth",),
    "scan2albedo.unlit.light_removal": (
        "UnlitScan",
        "unlit_scan",
    ),
    "scan2albedo.unlit.processed_face": (
        "Eyeball",
        "EyesAndMouth",
        "FaceMesh",
        "ProcessedFace",
    ),
    "scan2albedo.unlit.template_baking": (
        "TemplateTexture",
        "TemplateTile",
        "bake",
        "template_texture",
    ),
}

__all__ = [
    "Eyeball",
    "EyesAndMouth",
    "FaceMesh",
    "FaceReflectance",
    "Picture",
    "ProcessedFace",
    "RelightOptions",
    "RelitFace",
    "SwapOptions",
    "TemplateTexture",
    "TemplateTile",
    "TransferOptions",
    "UnlitScan",
    "bake",
    "blend_faces",
    "default_camera",
    "engine_maps",
    "eyes_and_mouth",
    "frames_srgb",
    "light_arc",
    "load_result",
    "personal_model",
    "reflectance_of_processed",
    "relight",
    "swap_texture",
    "sweep",
    "template_texture",
    "transfer_expression",
    "unlit_scan",
    "write_face",
    "write_frames",
    "write_gif",
]

__getattr__ = loaded_when_asked(__name__, _HOMES)
