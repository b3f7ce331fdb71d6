"""`Chart`: which chart images lie on, so that a texel is the same place of every face."""

from __future__ import annotations

from dataclasses import dataclass

from scan2albedo.errors import RecognitionError


@dataclass(frozen=True)
class Chart:
    """The chart of a set of images.

    Parameters
    ----------
    model : str or None
        Name of the face model; None where nobody told.
    shape : (int, int)
        Height and width in texels.
    """

    model: str | None
    shape: tuple[int, int]

    def __str__(self) -> str:
        size = f"{self.shape[1]} x {self.shape[0]} texels"
        return size if self.model is None else f"{size} of model {self.model!r}"


def common_chart(a: Chart | None, b: Chart | None, what_a: str, what_b: str) -> Chart | None:
    """Return the chart of two sets of images, with what either knows of it.

    Raises
    ------
    RecognitionError
        When sizes or models differ; names both sets and both charts.

    Examples
    --------
    >>> common_chart(Chart(None, (256, 256)), Chart("mine", (256, 256)), "a", "b").model
    'mine'
    """
    if a is None or b is None:
        return b if a is None else a
    if a.shape != b.shape:
        raise RecognitionError(f"{what_a} has {a} and {what_b} {b}; process all scans with one --size")
    if None not in (a.model, b.model) and a.model != b.model:
        raise RecognitionError(
            f"{what_a} has {a} and {what_b} {b}, so their texels do not correspond; process all scans with "
            "one --model"
        )
    return a if b.model is None else b
