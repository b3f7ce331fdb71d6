"""Templates of whole manifests of results."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.chart import Chart, common_chart
from scan2albedo.recognition.manifest import Manifest
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.stored_albedo import read_albedo
from scan2albedo.recognition.templates import Templates, image_coefficients

CountCallback = Callable[[int, int], None]
"""Called with how many are done, of how many."""


def result_templates(
    manifest: Manifest,
    *,
    options: TemplateOptions = TemplateOptions(),
    on_count: CountCallback | None = None,
) -> Templates:
    """Return the templates of a manifest's results, from the albedo of the texels that were seen.

    They bear the person's name, or the result's where no person is named.

    Parameters
    ----------
    manifest : Manifest
    options : TemplateOptions
    on_count : callable, optional
        Called after each result with how many are done, and of how many.

    Raises
    ------
    RecognitionError
        When a result cannot be read or used, or results differ in size or model; names file, line and result.

    Notes
    -----
    About 0.1 s a result of 512 texels; one is in memory at a time.
    """
    coefficients, masks = [], []
    charts: list[tuple[str, Chart]] = []
    for k, entry in enumerate(manifest.entries):
        where = manifest.where(entry)
        try:
            stored = read_albedo(entry.path)
            bands, carried = image_coefficients(stored.albedo_linear, stored.seen, options, entry.result)
        except RecognitionError as error:
            raise RecognitionError(f"{where}: {error}") from error
        for other, chart in charts:
            common_chart(chart, stored.chart, other, where)
        if not charts or (stored.chart.model is not None and charts[-1][1].model is None):
            charts.append((entry.result, stored.chart))
        coefficients.append(bands.astype(np.complex64))
        masks.append(carried)
        if on_count is not None:
            on_count(k + 1, len(manifest.entries))
    names = tuple(entry.person or entry.result for entry in manifest.entries)
    return Templates(np.stack(coefficients), np.stack(masks), names, options, charts[-1][1])
