"""The public face model: the default one, or made from anyone's template."""

from scan2albedo.templates.annotated_face_model import AnnotatedFaceModel, chosen_model

__all__ = ["AnnotatedFaceModel", "chosen_model"]
