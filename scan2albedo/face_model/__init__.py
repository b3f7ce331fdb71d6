"""The annotated surface that the stages work on, the default one and files of others."""

from scan2albedo.face_model.annotation import AnnotatedSurface, Region, default_model

__all__ = ["AnnotatedSurface", "Region", "default_model"]
