"""The transformers do what the functions do, in the manner of scikit-learn."""

import numpy as np
import pytest

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import (
    DistanceTransformer,
    TemplateTransformer,
    albedo_templates,
    similarity_matrix,
)


def test_steps_in_a_row_are_the_functions(albedo, face_like_mask):
    gallery, probes = [albedo(0), albedo(1), albedo(2)], [albedo(1) + 0.01 * albedo(3)]
    first, second = TemplateTransformer(mask=face_like_mask), DistanceTransformer(window=5)
    distances = second.fit_transform(first.fit_transform(gallery))
    templates = albedo_templates(gallery, ["0", "1", "2"], masks=[face_like_mask] * 3)
    np.testing.assert_array_equal(
        distances, np.clip(1 - similarity_matrix(templates, templates, window=5), 0, 1)
    )
    assert second.transform(first.transform(probes))[0].argmin() == 1


@pytest.mark.parametrize("kind", [TemplateTransformer, DistanceTransformer])
def test_parameters_make_an_equal_one(kind):
    transformer = kind()
    parameters = transformer.get_params()
    name = next(iter(parameters))
    other = kind(**parameters).set_params(**{name: 9})
    assert other.get_params() == parameters | {name: 9}
    assert transformer.get_params() == parameters
    assert f"{name}=9" in repr(other)
    with pytest.raises(ValueError, match="no parameter 'colour'"):
        other.set_params(colour=1)


def test_bad_parameters_are_refused_when_fitted(albedo):
    with pytest.raises(ValueError, match="size is 0"):
        TemplateTransformer(size=0).fit([albedo(0)])
    with pytest.raises(RecognitionError, match="no image"):
        TemplateTransformer().fit([])


def test_order_and_sizes_are_checked(albedo):
    templates = albedo_templates([albedo(0)], ["ann"])
    with pytest.raises(RecognitionError, match="call fit first"):
        TemplateTransformer().transform([albedo(0)])
    with pytest.raises(RecognitionError, match="call fit first"):
        DistanceTransformer().transform(templates)
    with pytest.raises(RecognitionError, match="gallery is empty"):
        DistanceTransformer().fit(templates.select([]))
    with pytest.raises(RecognitionError, match="image 1 has"):
        TemplateTransformer().fit([albedo(0)]).transform([albedo(0), albedo(0, (130, 130))])
