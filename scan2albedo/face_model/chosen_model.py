"""The model that a user means by a name, a file, or a model."""

from __future__ import annotations

from pathlib import Path

from scan2albedo.errors import ModelError
from scan2albedo.face_model.model import AnnotatedFaceModel
from scan2albedo.face_model.template_file import TEMPLATE_FILES, model_from_file


def chosen_model(model: AnnotatedFaceModel | str | Path | None) -> AnnotatedFaceModel | None:
    """Return the model that a user means: a model, a file of one or of a template, "default" or "none".

    Raises
    ------
    ModelError
        When there is no such file, or it holds neither.
    """
    if isinstance(model, AnnotatedFaceModel):
        return model
    if model is None or str(model) == "default":
        return AnnotatedFaceModel.default()
    if str(model) == "none":
        return None
    if not Path(model).is_file():
        raise ModelError(
            f"{model}: no such file; give a model's JSON file, a template's mesh, 'default' or 'none'"
        )
    if Path(model).suffix.lower() in TEMPLATE_FILES:
        return model_from_file(model)
    return AnnotatedFaceModel.load(model)
