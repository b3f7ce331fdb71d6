"""Recognition's steps with scikit-learn's interface; scikit-learn itself is not needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.similarity import WINDOW, similarity_matrix
from scan2albedo.recognition.templates import TemplateOptions, Templates, albedo_templates

Images = Sequence[ArrayLike] | NDArray[Any]


class _Transformer:
    """`get_params` and `set_params` of a dataclass whose fields are the parameters."""

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the parameters by name; none has parameters of its own, so `deep` changes nothing."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def set_params(self, **parameters: Any) -> Self:
        """Set parameters by name and return the transformer; ValueError when there is no such parameter."""
        known = self.get_params()
        for name, value in parameters.items():
            if name not in known:
                raise ValueError(f"{type(self).__name__} has no parameter {name!r}, but {', '.join(known)}")
            setattr(self, name, value)
        return self

    def _check_fitted(self, attribute: str) -> None:
        if not hasattr(self, attribute):
            raise RecognitionError(f"{type(self).__name__} was not fitted; call fit first")


@dataclass(eq=False, kw_only=True)
class TemplateTransformer(_Transformer):
    """Albedos to templates; `size` and `unit_mean` are those of `TemplateOptions`.

    `mask` (H, W) bool tells where the albedos are known, in all of them.

    Examples
    --------
    >>> albedos = np.random.default_rng(0).random((3, 128, 128))
    >>> TemplateTransformer(size=64).fit_transform(albedos, ["ann", "bob", "cy"]).coefficients.shape
    (3, 10, 16, 16)
    """

    size: int | None = TemplateOptions.size
    unit_mean: bool = TemplateOptions.unit_mean
    mask: NDArray[np.bool_] | None = None

    def fit(self, images: Images, names: Sequence[str] | None = None) -> Self:
        """Check the parameters and keep the images' size, which `transform` then expects.

        RecognitionError when there is no image.
        """
        if len(images) == 0:
            raise RecognitionError("no image was given; templates need one or more")
        self.options_ = TemplateOptions(size=self.size, unit_mean=self.unit_mean)
        self.image_shape_ = np.shape(images[0])[:2]
        return self

    def transform(self, images: Images, names: Sequence[str] | None = None) -> Templates:
        """Return the templates of images (N, H, W) or (N, H, W, 3), named by number by default.

        RecognitionError before `fit`, and when an image has another size than those or cannot be used.
        """
        self._check_fitted("options_")
        for k, image in enumerate(images):
            if np.shape(image)[:2] != self.image_shape_:
                raise RecognitionError(
                    f"image {k} has {np.shape(image)[:2]} pixels, those that were fitted "
                    f"{self.image_shape_}; give images of one size"
                )
        chosen = [str(k) for k in range(len(images))] if names is None else names
        masks = None if self.mask is None else [self.mask] * len(images)
        return albedo_templates(images, chosen, masks=masks, options=self.options_)

    def fit_transform(self, images: Images, names: Sequence[str] | None = None) -> Templates:
        """Return `fit(images).transform(images, names)`."""
        return self.fit(images).transform(images, names)


@dataclass(eq=False, kw_only=True)
class DistanceTransformer(_Transformer):
    """Templates to their distances 1 - S from those that were fitted, for classifiers that take distances.

    `window` is that of `cw_ssim`.
    """

    window: int = WINDOW

    def fit(self, templates: Templates, names: Sequence[str] | None = None) -> Self:
        """Keep the templates of the gallery; RecognitionError when there is none."""
        if len(templates) == 0:
            raise RecognitionError("the gallery is empty; give one template or more")
        self.gallery_ = templates
        return self

    def transform(self, templates: Templates) -> NDArray[np.float64]:
        """Return distances (N, gallery), 0 to 1; RecognitionError before `fit`."""
        self._check_fitted("gallery_")
        return np.clip(1.0 - similarity_matrix(templates, self.gallery_, window=self.window), 0.0, 1.0)

    def fit_transform(self, templates: Templates, names: Sequence[str] | None = None) -> NDArray[np.float64]:
        """Return `fit(templates).transform(templates)`."""
        return self.fit(templates).transform(templates)
