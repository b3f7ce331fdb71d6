"""Morphable models of reflectance learned from files, samples of them, and their files."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo import reflectance
from scan2albedo.core.arrays import FloatArray, Values, attributes, norms
from scan2albedo.errors import ReflectanceError, errors_of, one_line
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.io.npz import read_npz
from scan2albedo.reflectance import MeshReflectance, VertexReflectance, read_reflectance, write_reflectance
from scan2albedo.reflectance.morphable_model import held_out_components, reliability
from scan2albedo.reflectance.reflectance_files import RESULT_FILE
from scan2albedo.report.overview import Panel, overview_picture
from scan2albedo.report.reflectance_views import albedo_colors, albedo_white, face_picture
from scan2albedo.runs.reflectance import MEAN_FILE, MODEL_FILE, SHAPE_FILE, publishing
from scan2albedo.templates import AnnotatedFaceModel

DEFAULT_MODEL_FILE = Path(reflectance.reflectance_files.__file__).parent / "data" / "synthetic_people.npz"
SURFACE_LEVELS = 1
"""Refinements of the default face model's surface for synthetic people."""


@dataclass(frozen=True)
class FaceModels:
    """A model, its mean on the mean mesh, and the shapes' model if there is one."""

    model: reflectance.MorphableReflectanceModel
    mean: MeshReflectance
    shape: reflectance.MorphableShapeModel | None
    """Where it is known which vertices are landmarks."""
    sources: tuple[Path, ...] = ()
    """Of the samples; none for synthetic people."""
    folder: Path | None = None
    """From which it was read."""

    def __str__(self) -> str:
        return "the model of synthetic people" if self.folder is None else f"the model in {self.folder}"


def read_sample(path: Path) -> MeshReflectance:
    """Read the reflectance of a file, of the folder of a fit, or of that of a processed scan."""
    if not path.is_dir() or (path / RESULT_FILE).is_file():
        return read_reflectance(path)
    if not (path / "result.json").is_file():
        raise ReflectanceError(
            f"{path} holds neither {RESULT_FILE} nor result.json: give the folder of a fit or of a "
            "processed scan, or a reflectance's .npz file"
        )
    from scan2albedo.applications import reflectance_of_processed

    face = reflectance_of_processed(path)
    return MeshReflectance(face.mesh.vertices, face.mesh.faces, face.reflectance)


def build_model(
    sources: Sequence[Path],
    *,
    components: int | None = None,
    least_support: float = 0.5,
    landmark_vertices: Path | None = None,
) -> FaceModels:
    """Learn a model from files or folders, see `read_sample` and `MorphableReflectanceModel.from_samples`.

    Vertices count by how well their fit knows them. Meshes are aligned rigidly to the first before their mean
    is taken. With `landmark_vertices`, a JSON file with the 68 landmarks' vertex numbers in iBUG-68 order, a
    shape model is learned, too. Raises `ReflectanceError` when a file is unusable or meshes differ,
    `ValueError` for options out of range.
    """
    samples = [read_sample(path) for path in sources]
    first, faces = samples[0].vertices, samples[0].faces
    for path, sample in zip(sources, samples, strict=True):
        if len(sample.vertices) != len(first) or not np.array_equal(sample.faces, faces):
            raise ReflectanceError(
                f"{path} has other triangles than {sources[0]}; a model needs one topology: fit captures of "
                "meshes that correspond, or process scans with one model"
            )
    model = reflectance.MorphableReflectanceModel.from_samples(
        [sample.reflectance for sample in samples],
        components=components,
        least_support=least_support,
        weights=[reliability(sample.reflectance, sample.std) for sample in samples],
    )
    shapes = _laid_on(first, samples)
    shape = None
    if landmark_vertices is not None:
        what = f"landmark vertices {landmark_vertices}"
        try:
            numbers = np.asarray(json.loads(landmark_vertices.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise ReflectanceError(f"{what} cannot be read ({one_line(error)}); give a JSON list") from error
        with errors_of(what, ReflectanceError):
            shape = reflectance.MorphableShapeModel.from_samples(shapes, None, faces, numbers)
        if len(np.unique(numbers)) < len(numbers):
            raise ReflectanceError(f"{what}: two landmarks have one vertex; give 68 different ones")
    mean = MeshReflectance(shapes.mean(0), faces, model.mean_reflectance)
    return FaceModels(model, mean, shape, tuple(sources))


def _laid_on(first: FloatArray, meshes: Sequence[Any]) -> FloatArray:
    """Return the vertices (K, V, 3) of meshes, each aligned rigidly to the first's (V, 3)."""
    return np.stack([transform_points(procrustes(one.vertices, first), one.vertices) for one in meshes])


def synthetic_model(count: int, *, components: int | None = None) -> FaceModels:
    """Learn a model of reflectance and shape from `count` people of the synthetic population.

    Their albedo is taken from the generator, without photographs. The number of directions is that which
    predicts people left out best (`held_out_components`) when `components` is None. Takes 0.1 s of CPU a
    person. Raises `ReflectanceError` for fewer than two people, or than 10 without `components`.
    """
    from scan2albedo.synthetic import population_reflectance
    from scan2albedo.synthetic.face_shape import expression_offsets

    if count < 2:
        raise ReflectanceError(f"{count} people make no model; give 2 or more")
    template = AnnotatedFaceModel.default()
    people = [population_reflectance(k, SURFACE_LEVELS) for k in range(count)]
    known = np.ones(len(people[0].vertices), bool)
    samples = [VertexReflectance(one.diffuse_linear, one.weights, known) for one in people]
    rest, faces = template.surface(SURFACE_LEVELS)
    if components is None:
        components = held_out_components(samples, rest)
    model = reflectance.MorphableReflectanceModel.from_samples(samples, components=components)
    shapes = _laid_on(rest, people)
    assert template.landmarks is not None
    nearest = norms(rest - template.landmarks[:, None]).argmin(1)
    offsets = expression_offsets(template, np.random.default_rng([0, 14]), levels=SURFACE_LEVELS)
    shape = reflectance.MorphableShapeModel.from_samples(shapes, offsets, faces, nearest)
    return FaceModels(model, MeshReflectance(shapes.mean(0), faces, model.mean_reflectance), shape)


def default_model() -> FaceModels:
    """Return `synthetic_model(200)`, rounded, from what tools/build/reflectance_model.py makes."""
    advice = "install the package anew"
    arrays = read_npz(DEFAULT_MODEL_FILE, what="reflectance model", advice=advice, error=ReflectanceError)

    def part(name: str) -> list[FloatArray]:
        return [arrays[f"{name}_mean"].astype(float), arrays[f"{name}_step"] * arrays[f"{name}_basis"]]

    template = AnnotatedFaceModel.default()
    to_surface, (_, faces) = template.subdivision(SURFACE_LEVELS).matrix, template.surface(SURFACE_LEVELS)
    # Two of the three shares of the lobes are stored; the shares sum to 1 and their directions to 0.
    shares = [
        np.concatenate([two, whole - two.sum(-1, keepdims=True)], axis=-1)
        for two, whole in zip(part("share"), (1, 0), strict=True)
    ]
    people, count, variance = int(arrays["people"]), len(shares[0]), float(arrays["total_variance"])
    columns = zip(part("diffuse"), (total[..., None] for total in part("total")), shares, strict=True)
    mean, basis = (np.concatenate(three, axis=-1) for three in columns)
    known, support = np.ones(count, bool), np.full(count, people)
    model = reflectance.MorphableReflectanceModel(mean, basis, known, support, variance, people)
    shape_mean, shape_basis = part("shape")
    shape = reflectance.MorphableShapeModel(
        to_surface @ shape_mean,
        np.stack([to_surface @ direction for direction in shape_basis]),
        int(arrays["identity_components"]),
        faces,
        arrays["landmark_vertices"],
    )
    return FaceModels(model, MeshReflectance(shape.mean, faces, model.mean_reflectance), shape)


def write_model_folder(built: FaceModels, out: Path, options: Values) -> Values:
    """Write the model, its mean on the mean mesh, and a sheet; return figures as in `reflectance.json`."""
    model = built.model
    figures: Values = {"vertices": len(model.known), "known_vertices": model.known.sum()}
    figures |= attributes(model, "samples", "components", "explained", "deviation")
    with publishing(out, "build", built.sources, options, figures) as results:
        model.save(results.folder / MODEL_FILE)
        write_reflectance(results.folder / MEAN_FILE, built.mean)
        if built.shape is not None:
            built.shape.save(results.folder / SHAPE_FILE)
        title = f"{model.samples} samples, {model.components} directions"
        if shown := min(4, model.components):
            part = 100 * model.explained[:shown].sum()
            title += f"; the first {shown} hold {part:.0f} % of the variance"
        white = albedo_white(built.mean.reflectance.diffuse_linear)
        panels = [_panel("mean", built.mean, white)]
        for number, side in itertools.product(range(shown), (-2, 2)):
            changed = model.reconstruct(side * np.eye(model.components)[number]).reflectance
            name = f"direction {number + 1}, {side:+d} deviations"
            panels.append(_panel(name, replace(built.mean, reflectance=changed), white))
        results.picture("model.png", overview_picture(title, panels))
    return figures


def read_model_folder(path: Path) -> FaceModels:
    """Read the folder that `build` or `finetune` wrote, whose files must belong together."""
    if not path.is_dir():
        raise ReflectanceError(f"{path} is not a folder; give the one that `reflectance build` wrote")
    model = reflectance.MorphableReflectanceModel.load(path / MODEL_FILE)
    mean = read_reflectance(path / MEAN_FILE)
    shape = reflectance.MorphableShapeModel.load(path / SHAPE_FILE) if (path / SHAPE_FILE).exists() else None
    counts = {MODEL_FILE: len(model.known), MEAN_FILE: len(mean.vertices)}
    if shape is not None:
        counts[SHAPE_FILE] = len(shape.mean)
    if len(set(counts.values())) > 1:
        text = ", ".join(f"{name} has {count} vertices" for name, count in counts.items())
        raise ReflectanceError(f"{path}: {text}; build the model again")
    return FaceModels(model, mean, shape, folder=path)


def write_samples(folder: Path, out: Path, *, count: int, seed: int, scale: float = 1.0) -> Values:
    """Write reflectances drawn from the model in a folder, each a file, and a sheet; return the figures."""
    models = read_model_folder(folder)
    drawn = [models.model.sample(np.random.default_rng([seed, k]), scale=scale) for k in range(count)]
    names, figures = ("coefficients", "clipped_share"), Values(samples=count)
    figures |= {name: [getattr(one, name) for one in drawn] for name in names}
    options = {"count": count, "seed": seed, "scale": scale}
    with publishing(out, "sample", (folder,), options, figures) as results:
        white, panels = albedo_white(models.mean.reflectance.diffuse_linear), []
        for number, one in enumerate(drawn):
            mesh = replace(models.mean, reflectance=one.reflectance)
            write_reflectance(results.folder / f"sample_{number:03d}.npz", mesh)
            panels.append(_panel(f"sample {number}", mesh, white))
        results.picture("samples.png", overview_picture(f"{count} samples of {folder.name}", panels, 6))
    return figures


def _panel(name: str, mesh: MeshReflectance, white: float) -> Panel:
    return Panel(name, face_picture(mesh, albedo_colors(mesh.reflectance.diffuse_linear, white=white)))
