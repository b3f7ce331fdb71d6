"""What a processed face is for: other light, skin or expression; the scan itself, and templates, unlit."""

from typing import TYPE_CHECKING

from scan2albedo.lazy import names_when_asked

if TYPE_CHECKING:
    from scan2albedo.applications.blending import blend_faces as blend_faces
    from scan2albedo.applications.expression_transfer import (
        TransferOptions as TransferOptions,
        personal_model as personal_model,
        transfer_expression as transfer_expression,
    )
    from scan2albedo.applications.face_reflectance import (
        FaceReflectance as FaceReflectance,
        reflectance_of_processed as reflectance_of_processed,
    )
    from scan2albedo.applications.files import load_result as load_result, write_face as write_face
    from scan2albedo.applications.light_sweep import (
        frames_srgb as frames_srgb,
        light_arc as light_arc,
        sweep as sweep,
        write_frames as write_frames,
        write_gif as write_gif,
    )
    from scan2albedo.applications.relighting import (
        RelightOptions as RelightOptions,
        RelitFace as RelitFace,
        default_camera as default_camera,
        relight as relight,
    )
    from scan2albedo.applications.texture_swap import SwapOptions as SwapOptions, swap_texture as swap_texture
    from scan2albedo.rendering.pictures import Picture as Picture
    from scan2albedo.unlit.engine_maps import engine_maps as engine_maps
    from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth as eyes_and_mouth
    from scan2albedo.unlit.light_removal import UnlitScan as UnlitScan, unlit_scan as unlit_scan
    from scan2albedo.unlit.processed_face import (
        Eyeball as Eyeball,
        EyesAndMouth as EyesAndMouth,
        FaceMesh as FaceMesh,
        ProcessedFace as ProcessedFace,
    )
    from scan2albedo.unlit.template_baking import (
        TemplateTexture as TemplateTexture,
        TemplateTile as TemplateTile,
        bake as bake,
        template_texture as template_texture,
    )

__getattr__, __dir__, __all__ = names_when_asked(__name__, __file__)
