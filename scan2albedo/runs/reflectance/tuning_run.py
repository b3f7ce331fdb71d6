"""From photographs of several faces to a finer model, and its files."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core import Budget, ProgressCallback
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import (
    FineTuning,
    ImageObservation,
    LightingModel,
    MeshReflectance,
    finetune,
    read_photograph,
    write_reflectance,
)
from scan2albedo.runs.reflectance.image_run import named_in_errors, notes_of_file, observe, shaped_vertices
from scan2albedo.runs.reflectance.model_run import MEAN_FILE, MODEL_FILE, SHAPE_FILE, ModelFolder
from scan2albedo.runs.reflectance.output import folder_of_results

_ONE_HELD_OUT_OF = 3
"""Photographs, when none is given to be held out."""


@dataclass(frozen=True)
class TunedModel:
    """A model after fine-tuning with photographs."""

    models: ModelFolder
    tuning: FineTuning
    photographs: tuple[Path, ...]
    held_out: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    """Caveats of the photograph files."""

    def metrics(self) -> dict[str, Any]:
        """Return the figures for `reflectance.json`."""
        tuning = self.tuning
        return {
            "photographs": [str(path) for path in self.photographs],
            "held_out": [str(path) for path in self.held_out],
            "accepted_steps": tuning.accepted_steps,
            "held_out_before": tuning.held_out_before,
            "held_out_after": tuning.held_out_after,
            "converged": tuning.converged,
        }


def tune_model(
    models: ModelFolder,
    photographs: Sequence[Path],
    held_out: Sequence[Path] = (),
    *,
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> TunedModel:
    """Fine-tune a model with photograph files, and test it on others: `held_out`, or one of three when empty.

    `say` gets a line for each photograph. Raises `ReflectanceError` when there are too few, or one cannot be
    used.
    """
    tuned_with, tested_on = _parted(list(photographs), list(held_out))
    lighting = LightingModel.default()
    notes: list[str] = []

    def observed(path: Path) -> ImageObservation:
        say(f"reading {path}")
        photograph = read_photograph(path)
        notes.extend(notes_of_file(photograph))
        with named_in_errors(photograph):
            vertices, _, _ = shaped_vertices(photograph, models, lighting)
            return observe(photograph, vertices, models.mean.faces)

    tuning = finetune(
        models.model,
        [observed(path) for path in tuned_with],
        [observed(path) for path in tested_on],
        models.mean.faces,
        vertices=models.mean.vertices,
        lighting=lighting,
        budget=budget,
        on_progress=on_progress,
    )
    mean = tuning.model.reconstruct(np.zeros(tuning.model.components)).reflectance
    better = replace(
        models, model=tuning.model, mean=MeshReflectance(models.mean.vertices, models.mean.faces, mean)
    )
    return TunedModel(better, tuning, tuple(tuned_with), tuple(tested_on), tuple(notes))


def write_tuned_model(done: TunedModel, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Write the model's folder anew; return figures as in `reflectance.json`."""
    figures = done.metrics()
    models = done.models
    assert models.folder is not None  # models that are tuned come from files
    with folder_of_results(out, "finetune", (models.folder, *done.photographs, *done.held_out)) as results:
        models.model.save(results.folder / MODEL_FILE)
        write_reflectance(results.folder / MEAN_FILE, models.mean)
        if models.shape is not None:
            shutil.copyfile(models.folder / SHAPE_FILE, results.folder / SHAPE_FILE)
        done.tuning.trace.to_csv(results.folder / "trace.csv")
        results.figure("error_vs_time.png", done.tuning.trace.plot())
        ended = () if done.tuning.converged else ("budget or rounds ended while changes still helped",)
        results.write_record(figures, options=options, notes=(*done.notes, *ended))
    return figures


def _parted(photographs: list[Path], held_out: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return photographs to tune with and to test on."""
    tuned_with, tested_on = ({path.resolve() for path in paths} for paths in (photographs, held_out))
    if both := tuned_with & tested_on:
        raise ReflectanceError(f"{min(both)} is held out and tuned with; give it once")
    if not held_out:
        held_out = photographs[_ONE_HELD_OUT_OF - 1 :: _ONE_HELD_OUT_OF]
        photographs = [path for path in photographs if path not in held_out]
    if not photographs or not held_out:
        raise ReflectanceError(
            f"{len(photographs)} photographs to tune with and {len(held_out)} held out; give one or more of "
            f"each, or {_ONE_HELD_OUT_OF} or more in all"
        )
    return photographs, held_out
