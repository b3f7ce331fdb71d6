"""The commands for reflectance: thin wrappers around the library's calls."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scan2albedo.cli import common
from scan2albedo.core.arrays import Values

if TYPE_CHECKING:
    from scan2albedo.cli.progress import ProgressLines

app = typer.Typer(
    help="Reflectance of faces: from flash photographs, and as a morphable model.", no_args_is_help=True
)

SeedOption = Annotated[int, typer.Option(help="Seed of every random step.", min=0)]
CaptureArgument = Annotated[
    Path, typer.Argument(help="A capture file: poses, flashes, pictures, mesh.", metavar="CAPTURE")
]
ModelArgument = Annotated[
    Path, typer.Argument(help="Folder that `reflectance build` or `finetune` wrote.", metavar="MODEL")
]


@app.command()
def olat(capture: CaptureArgument, out: common.OutFolder, json_summary: common.JsonOption = False) -> None:
    """Write what each flash added to the room's light, as linear EXR pictures.

    Light is value^gamma with the capture file's `gamma`; 1.2 is taken, and noted, when it gives none.
    """
    with _work("olat", out, json_summary) as (_, report):
        from scan2albedo.reflectance import read_capture
        from scan2albedo.runs.reflectance.capture_run import write_olat

        figures = write_olat(read_capture(capture), out)
        valid = f"{100 * figures['valid_share']:.2f} % of the pixels valid"
        report(f"{figures['pairs']} pairs, {valid}", figures)


@app.command()
def fit(
    capture: CaptureArgument,
    out: common.OutFolder,
    light_gains: bool = typer.Option(
        False, help="Find the strength of each flash, too; otherwise all are equal."
    ),
    loss: str = typer.Option("cauchy", help="cauchy, charbonnier or squares."),
    held_out_every: int = typer.Option(
        10, help="One pair of this many tests a fit without it; 0: no test.", min=0
    ),
    least_pairs: int = typer.Option(3, help="Vertices seen in fewer pairs are left unknown.", min=1),
    normal_sigma: str = typer.Option(
        "auto", help="Deviation of the mesh's normals; 0 if they are right.", metavar="DEGREES|auto"
    ),
    budget: common.BudgetOption = None,
    json_summary: common.JsonOption = False,
) -> None:
    """Fit albedo and three highlight lobes to each vertex of a capture's mesh.

    The capture file should give `gamma` (light = value^gamma): 1 for linear pictures, about 2.2 for sRGB.
    When it does not, 1.2 is taken, and noted.
    """
    from scan2albedo.reflectance import ReflectanceFitOptions

    sigma: float | str = normal_sigma
    with suppress(ValueError):
        sigma = float(normal_sigma)
    try:
        options = ReflectanceFitOptions(
            loss=loss, light_gains=light_gains, least_pairs=least_pairs, normal_sigma_degrees=sigma
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    if held_out_every == 1:
        raise typer.BadParameter("--held-out-every 1 would leave nothing to fit; give 0, or 2 or more")
    spend = common.checked_budget(budget)
    with _work("fit", out, json_summary) as (progress, report):
        from scan2albedo.reflectance import read_capture
        from scan2albedo.runs.reflectance.capture_run import fit_capture, write_fit

        done = fit_capture(
            read_capture(capture),
            options=options,
            held_out_every=held_out_every,
            budget=spend,
            on_progress=progress.update,
        )
        figures = write_fit(
            done,
            out,
            {"light_gains": light_gains, "loss": loss, "held_out_every": held_out_every}
            | {"least_pairs": least_pairs, "normal_sigma": normal_sigma, "budget": budget},
        )
        known = f"{figures['known_vertices']} of {figures['vertices']} vertices"
        text = f"{known} from {figures['pairs']} pairs"
        if left_out := figures["pairs_of_capture"] - figures["pairs"]:
            text += f", {left_out} left out"
        if "held_out" in figures:
            text += f"; pictures left out are predicted to {100 * figures['held_out']['relative_rmse']:.1f} %"
        report(text, figures)


@app.command()
def build(
    out: common.OutFolder,
    samples: list[Path] | None = typer.Argument(
        None, help="Folders of fits or processed scans, or .npz files.", metavar="[SAMPLE...]"
    ),
    synthetic: int | None = typer.Option(
        None, help="Learn from this many synthetic people instead, as 200.", min=2
    ),
    components: int | None = typer.Option(
        None, help="Directions to keep; otherwise all, of synthetic people the best number.", min=0
    ),
    least_support: float = typer.Option(
        0.5, help="Share of the samples that must know a vertex, above 0 and up to 1."
    ),
    landmark_vertices: Path | None = typer.Option(
        None, help="JSON list of the 68 landmarks' vertices, to learn shapes too."
    ),
    json_summary: common.JsonOption = False,
) -> None:
    """Learn a morphable model of reflectance from several faces."""
    if not 0 < least_support <= 1:
        raise typer.BadParameter(f"--least-support is {least_support}, expected above 0 and up to 1")
    if bool(samples) == (synthetic is not None):
        raise typer.BadParameter("give either samples or --synthetic with a number of people, as 200")
    with _work("build", out, json_summary) as (_, report):
        from scan2albedo.runs.reflectance.model_run import build_model, synthetic_model, write_model_folder

        if synthetic is not None:
            built = synthetic_model(synthetic, components=components)
        else:
            built = build_model(
                samples or (),
                components=components,
                least_support=least_support,
                landmark_vertices=landmark_vertices,
            )
        options = {"components": components, "least_support": least_support, "synthetic": synthetic}
        figures = write_model_folder(built, out, options)
        known = f"{figures['known_vertices']} of {figures['vertices']} vertices"
        text = f"{figures['components']} directions from {figures['samples']} faces, {known}"
        report(text, figures)


@app.command()
def sample(
    model: ModelArgument,
    out: common.OutFolder,
    count: int = typer.Option(6, help="How many.", min=1),
    scale: float = typer.Option(
        1.0, help="Standard deviation of the coefficients; 1 is the model's own.", min=0
    ),
    seed: SeedOption = 0,
    json_summary: common.JsonOption = False,
) -> None:
    """Draw reflectances from a model."""
    with _work("sample", out, json_summary) as (_, report):
        from scan2albedo.runs.reflectance.model_run import write_samples

        figures = write_samples(model, out, count=count, seed=seed, scale=scale)
        report(f"{count} reflectances", figures)


@app.command("fit-image")
def fit_image(
    photograph: Annotated[
        Path, typer.Argument(help="A file with image, camera, mesh or landmarks.", metavar="PHOTOGRAPH")
    ],
    out: common.OutFolder,
    model: Path | None = typer.Option(
        None, help="Folder that `build` or `finetune` wrote; otherwise that of `build --synthetic 200`."
    ),
    budget: common.BudgetOption = None,
    json_summary: common.JsonOption = False,
) -> None:
    """Find the reflectance and the light of one photograph with a model, or say that it does not show."""
    spend = common.checked_budget(budget)
    with _work("fit-image", out, json_summary) as (progress, report):
        from scan2albedo.reflectance import read_photograph
        from scan2albedo.runs.reflectance.image_run import fit_photograph, write_fitted_photograph
        from scan2albedo.runs.reflectance.model_run import default_model, read_model_folder

        taken = read_photograph(photograph)
        models = default_model() if model is None else read_model_folder(model)
        done = fit_photograph(taken, models, budget=spend, on_progress=progress.update)
        figures = write_fitted_photograph(done, models, out, {"budget": budget})
        rmse = f"relative RMSE {100 * figures['relative_rmse']:.1f} %"
        text = f"{rmse} over {figures['seen_vertices']} vertices"
        report(text, figures)


@app.command("finetune")
def finetune(
    model: ModelArgument,
    photographs: Annotated[
        list[Path], typer.Argument(help="Photograph files of other faces.", metavar="PHOTOGRAPH...")
    ],
    out: common.OutFolder,
    held_out: list[Path] | None = typer.Option(
        None, help="A photograph to test on, repeatedly, best six or more; otherwise one of three."
    ),
    budget: common.BudgetOption = None,
    json_summary: common.JsonOption = False,
) -> None:
    """Improve a model with photographs; it changes only when photographs held out are explained better."""
    spend = common.checked_budget(budget)
    with _work("finetune", out, json_summary) as (progress, report):
        from scan2albedo.runs.reflectance.image_run import tune_model
        from scan2albedo.runs.reflectance.model_run import read_model_folder

        figures = tune_model(
            read_model_folder(model),
            photographs,
            held_out or (),
            out,
            {"budget": budget},
            budget=spend,
            on_progress=progress.update,
            say=lambda line: progress.say(f"finetune: {line}"),
        )
        changes = f"{len(figures['accepted_steps'])} changes accepted"
        before, after = figures["held_out_before"], figures["held_out_after"]
        text = f"{changes}, held-out {before:.4g} -> {after:.4g}"
        report(text, figures)


@app.command()
def demo(
    out: common.OutFolder = Path("reflectance_demo"),
    people: int = typer.Option(8, help="From whom the model is learned.", min=2),
    photographs: int = typer.Option(12, help="Of others, to fine-tune with; half are held out.", min=2),
    seed: SeedOption = 0,
    json_summary: common.JsonOption = False,
) -> None:
    """Photograph synthetic people, fit, learn and use a model, and print the error against the truth."""
    with _work("demo", out) as (progress, _):
        from scan2albedo.runs.reflectance.demo import report_lines, run_reflectance_demo

        figures = run_reflectance_demo(
            out,
            people=people,
            photographs=photographs,
            seed=seed,
            on_progress=progress.update,
            say=lambda line: progress.say(f"demo: {line}"),
        )
    if json_summary:
        common.echo_json({"out": str(out), **figures})
    else:
        typer.echo("\n".join(report_lines(figures)))


@contextmanager
def _work(
    name: str, out: Path, json_summary: bool = False
) -> Iterator[tuple[ProgressLines, Callable[[str, Values], None]]]:
    """Give progress lines for work that writes into `out`, and what says how it ended: text and figures."""
    from scan2albedo.io.run_folder import RunFolder
    from scan2albedo.runs.reflectance import FILES

    def report(text: str, figures: Values) -> None:
        for note in (*RunFolder(out, FILES).read().notes, f"{text}; files in {out}"):
            progress.say(f"{name}: {note}")
        if json_summary:
            common.echo_json({"out": str(out), **figures})

    # The demo writes folders of its own.
    with common.working(name, out, None if name == "demo" else FILES) as progress:
        yield progress, report
