"""Steps that a floor asks for and floors above it provide, so that no import points upward.

`scan2albedo/__init__.py`, which is loaded before every other module of the package, fills them in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Hook:
    """A function to be provided from above; `name` says what it is where nobody provided it."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._load: Callable[[], Callable[..., Any]] | None = None

    def provide(self, load: Callable[[], Callable[..., Any]]) -> None:
        """Keep `load`, which imports and returns the function when it is first asked for."""
        self._load = load

    def provided(self) -> Callable[..., Any]:
        """Return the function. Raises RuntimeError when nothing provided it."""
        if self._load is None:
            raise RuntimeError(f"{self._name} is not provided; import scan2albedo, which does it")
        return self._load()


TEMPLATE_ANNOTATOR = Hook("the annotator of face templates")
"""(TemplateSurface, DenseTemplate, control_size) -> AnnotatedSurface, see `AnnotatedFaceModel.from_mesh`."""
