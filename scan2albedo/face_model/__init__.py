"""The Annotated Face Model, the default one and templates of your own."""

from scan2albedo.face_model.annotation import Region
from scan2albedo.face_model.model import AnnotatedFaceModel, chosen_model

__all__ = ["AnnotatedFaceModel", "Region", "chosen_model"]
