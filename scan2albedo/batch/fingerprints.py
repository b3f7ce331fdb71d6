"""Hashes that tell whether a result is still that of its input and options."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from scan2albedo.core.version import VERSION
from scan2albedo.errors import ModelError
from scan2albedo.io.input_hash import file_sha256, files_of_scan
from scan2albedo.pipeline.options import ProcessOptions


def model_sha256(model: str) -> str | None:
    """Return the SHA-256 of a model's or a template's files; None for "none".

    Raises
    ------
    ModelError
        When there is no such file.
    """
    if model == "none":
        return None
    path = Path(_default_model() if model == "default" else model)
    arrays = path.with_suffix(".npz")
    try:
        files = [path, arrays] if path.suffix.lower() == ".json" else [*files_of_scan(path)]
        return hashlib.sha256("".join(file_sha256(f) for f in files if f.exists()).encode()).hexdigest()
    except OSError as error:
        raise ModelError(
            f"{model}: {error.strerror or error}; give a model's or a template's file"
        ) from error


def options_sha256(options: ProcessOptions, model_hash: str | None) -> str:
    """Return the SHA-256 of options, package version and model."""
    told = {"version": VERSION, "model_sha256": model_hash, **options.plain()}
    if options.model not in ("default", "none"):
        told["model"] = Path(str(options.model)).name  # its place does not count
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def folder_sha256(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file in a folder, by name."""
    return {path.name: file_sha256(path) for path in sorted(folder.iterdir()) if path.is_file()}


def changed_file(folder: Path, files: Mapping[str, str]) -> str | None:
    """Return the name of a file that is missing or not as it was, None when all are."""
    for name, sha256 in files.items():
        try:
            if file_sha256(folder / name) != sha256:
                return name
        except OSError:
            return name
    return None


@cache
def _default_model() -> Path:
    from scan2albedo import face_model

    return Path(str(face_model.__file__)).parent / "data" / "afm.json"
