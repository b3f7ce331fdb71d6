"""The commands for processed faces: swap, blend, transfer-expression, personal-model, bake."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from scan2albedo.cli.common import JsonOption, echo_json, say, stop_cleanly_on_interrupt

if TYPE_CHECKING:
    from scan2albedo.applications import ProcessedFace
    from scan2albedo.templates import AnnotatedFaceModel

Result = Annotated[Path, typer.Argument(help="Folder of a processed scan, OUT/<scan name>.")]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder for the new face.")]
ModelOption = Annotated[
    str, typer.Option(help="What the scans were processed with: a model's file, a mesh, or 'default'.")
]


def swap(
    a: Annotated[Path, typer.Argument(help="Folder of the processed scan that gives the shape.")],
    b: Annotated[Path, typer.Argument(help="Folder of the processed scan that gives the skin.")],
    out: OutFolder,
    keep_level: bool = typer.Option(
        False, "--keep-level", help="Leave B's albedo at its own level and colour, not A's."
    ),
    keep_color: bool = typer.Option(
        False, "--keep-color", help="Leave B's skin its own colour, at A's level."
    ),
    model: ModelOption = "default",
    json_summary: JsonOption = False,
) -> None:
    """Give A's shape B's skin."""
    from scan2albedo.applications import SwapOptions, swap_texture

    faces, template = _opened(out, [a, b], model)
    options = SwapOptions(match_level=not keep_level, match_color=not (keep_level or keep_color))
    made = swap_texture(*faces, options=options, model=template)
    _write_face(made, out, "swap", faces, asdict(options), json_summary)


def blend(
    a: Result,
    b: Result,
    out: OutFolder,
    weight: float = typer.Option(0.5, help="0 is all A, 1 is all B.", min=0, max=1),
    model: ModelOption = "default",
    json_summary: JsonOption = False,
) -> None:
    """Make a face between two, in shape and skin."""
    from scan2albedo.applications import blend_faces

    faces, template = _opened(out, [a, b], model)
    made = blend_faces(faces[0], faces[1], weight, model=template)
    _write_face(made, out, "blend", faces, {"weight": weight}, json_summary)


def transfer_expression(
    neutral_a: Annotated[Path, typer.Argument(help="Folder of A's processed scan at rest.")],
    expression_a: Annotated[Path, typer.Argument(help="Folder of A's processed scan with the expression.")],
    neutral_b: Annotated[Path, typer.Argument(help="Folder of B's processed scan at rest.")],
    out: OutFolder,
    strength: float = typer.Option(1.0, help="Factor of the expression."),
    correspondence: Literal["auto", "refined", "as-fitted"] = typer.Option(
        "auto",
        help="refined: A at rest is fitted to the face with the expression; as-fitted: it is not; auto: "
        "refined where the faces are on the model's mesh.",
    ),
    model: ModelOption = "default",
    json_summary: JsonOption = False,
) -> None:
    """Give B's face the expression of A's; the scans need no colour."""
    from scan2albedo import applications
    from scan2albedo.applications.expression_transfer import TWO_PEOPLE_MM, apart_where_still, level_to_refine

    options = applications.TransferOptions(strength=strength, correspondence=correspondence)
    faces, template = _opened(out, [neutral_a, expression_a, neutral_b], model, need_albedo=False)
    apart = apart_where_still(faces[0].mesh, faces[1].mesh)
    if apart > TWO_PEOPLE_MM:
        say(
            f"{faces[0].name} and {faces[1].name} seem to show two people: where an expression leaves a face "
            f"still they are {apart:.2f} mm apart (of one person up to {TWO_PEOPLE_MM:g}); what else differs "
            "between them goes into the new face, too"
        )
    made = applications.transfer_expression(*faces, options=options, model=template)
    refined = level_to_refine(faces[0].mesh, options, template) is not None
    chosen = {"strength": strength, "correspondence": "refined" if refined else "as-fitted"}
    _write_face(made, out, "transfer-expression", faces, chosen, json_summary)


def personal_model(
    result: Annotated[Path, typer.Argument(help="Folder of the person's processed scan at rest.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model: a .json file, and .npz beside it.")],
    model: ModelOption = "default",
    json_summary: JsonOption = False,
) -> None:
    """Make a model of one person, for process --model on other scans of the same person.

    Expressions then start from the person's own face at rest, which transfer-expression gains by; the chart
    stays, so results go with those of the model itself.
    """
    from scan2albedo import applications
    from scan2albedo.templates import chosen_model

    if out.suffix.lower() != ".json":
        raise typer.BadParameter(f"-o takes a name that ends in .json, not {out}")
    if out.resolve() == Path(model).resolve():
        raise typer.BadParameter(f"-o {out} is the model itself; choose another name")
    template = chosen_model(model)
    if template is None:
        raise typer.BadParameter("--model none has no shape to make a person's of")
    face = applications.load_result(result, need_albedo=False)
    stop_cleanly_on_interrupt(None)
    applications.personal_model(face, template).save(out)
    say(f"{face.name}: personal model in {out}")
    if json_summary:
        echo_json({"face": face.name, "status": "done", "out": str(out), "model": template.name})


def bake(
    source: Annotated[Path, typer.Argument(help="Mesh with a texture, or colours of its vertices.")],
    target: Annotated[Path, typer.Argument(help="Mesh with texture coordinates of its own.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="An .obj file; pictures and a GLB beside it.")],
    size: int = typer.Option(2048, help="Height and width of the texture, 8 to 8192.", min=8, max=8192),
    unit: Literal["auto", "mm", "cm", "m"] = typer.Option(
        "auto", help="Of both files: mm, cm or m; auto: mm, or by the face."
    ),
    through_face: bool = typer.Option(
        False, "--through-face", help="Register both faces: other pose, shape or person."
    ),
    json_summary: JsonOption = False,
) -> None:
    """Lay the colours of one mesh on the texture coordinates of another one."""
    from scan2albedo.applications import bake as baked
    from scan2albedo.io import load_scan
    from scan2albedo.io.load_scan import load_scan_with
    from scan2albedo.io.units import MM_PER_UNIT
    from scan2albedo.pipeline.process import process
    from scan2albedo.unlit.files import write_template

    if out.suffix.lower() != ".obj" or out.resolve() in (source.resolve(), target.resolve()):
        raise typer.BadParameter(f"-o takes a new name that ends in .obj, not {out}")
    fits: Any = None
    if through_face:
        done = [process(load_scan(path, unit), skip=("albedo",)) for path in (source, target)]
        # As registration left them: it may have turned their faces outward.
        meshes, fits = [result.scan for result in done], tuple(result.fitted for result in done)
    else:
        unit_scale = MM_PER_UNIT.get(unit, 1.0), f"unit: {'mm' if unit == 'auto' else unit}"
        meshes = [load_scan_with(path, lambda *_: unit_scale) for path in (source, target)]
    stop_cleanly_on_interrupt(None)
    made = baked(meshes[0], meshes[1], size, fits)
    write_template(out.parent, made, stem=out.stem, mm_per_unit=meshes[1].mm_per_unit)
    seen = float(np.mean([tile.seen.mean() for tile in made.tiles])) if made.tiles else 0.0
    say(f"{target.name}: {len(made.tiles)} tile(s), {seen:.0%} of their texels seen on {source.name}; {out}")
    if json_summary:
        echo_json({"status": "done", "out": str(out), "tiles": len(made.tiles), "seen": seen})


def _opened(
    out: Path, inputs: list[Path], model: str, *, need_albedo: bool = True
) -> tuple[list[ProcessedFace], AnnotatedFaceModel | None]:
    """Return faces and model; refuse to overwrite one that the new face is made of, or a processed scan."""
    from scan2albedo.applications.files import check_face_folder, load_result
    from scan2albedo.templates import chosen_model

    if out.resolve() in [path.resolve() for path in inputs]:
        raise typer.BadParameter(f"-o {out} is one of the inputs; choose another folder for the new face")
    check_face_folder(out)
    return [load_result(folder, need_albedo=need_albedo) for folder in inputs], chosen_model(model)


def _write_face(
    face: ProcessedFace,
    out: Path,
    application: str,
    inputs: list[ProcessedFace],
    options: dict[str, Any],
    json_summary: bool,
) -> None:
    from scan2albedo.applications import write_face

    stop_cleanly_on_interrupt(out)
    write_face(face, out, application=application, inputs=inputs, options=options)
    for text in (*face.notes, f"{application}; files in {out}"):
        say(f"{face.name}: {text}")
    if json_summary:
        names = [source.name for source in inputs]
        echo_json({"face": face.name, "status": "done", "out": str(out), "inputs": names, "options": options})
