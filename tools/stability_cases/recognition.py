"""Named extremes of recognition: templates, complex wavelet similarity, identification and its curves."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.recognition import (
    Identification,
    TemplateOptions,
    Templates,
    albedo_templates,
    cmc_curve,
    cw_ssim,
    identify,
    identify_by_similarity,
    roc_curve,
    similarity_matrix,
)
from stability_cases.case import Cases, Measured, assert_finite, naming

CASES = Cases()
STAGE = "recognition"


@cache
def _albedo(seed: int = 0, side: int = 128) -> FloatArray:
    """Return a field whose amplitude falls with frequency, within [0.1, 0.9]."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side))
    frequency[0, 0] = np.inf
    noise = np.fft.fft2(np.random.default_rng(seed).standard_normal((side, side)))
    field = np.fft.ifft2(noise / frequency).real
    return 0.1 + 0.8 * (field - field.min()) / np.ptp(field)


@cache
def _people(count: int = 4) -> Templates:
    return albedo_templates([_albedo(k) for k in range(count)], [f"person{k}" for k in range(count)])


def _probes(noise: float = 0.05) -> Templates:
    rng = np.random.default_rng(9)
    images = [_albedo(k) + noise * rng.standard_normal((128, 128)) for k in range(4)]
    return albedo_templates(images, [f"person{k}" for k in range(4)])


@CASES.extreme(STAGE, "constant images")
def _constant() -> str:
    same = cw_ssim(np.full((128, 128), 0.5), np.full((128, 128), 0.2))
    other = cw_ssim(np.full((128, 128), 0.5), _albedo())
    assert abs(same - 1) < 1e-6
    assert 0 <= other < 0.5
    return f"alike to one another {same:.3f}, to an albedo {other:.3f}"


@CASES.extreme(STAGE, "constant image in a gallery")
def _constant_person() -> str:
    gallery = albedo_templates([_albedo(0), np.ones((128, 128))], ["person0", "wall"])
    found = identify(gallery, albedo_templates([_albedo(0)], ["person0"]))
    assert found.predicted == ("person0",)
    return f"similarities {found.similarities[0].round(3).tolist()}"


@CASES.extreme(STAGE, "images of contrast 1e-9")
def _faint() -> str:
    a, b = (1 + 1e-9 * _albedo(k) for k in (0, 1))
    assert cw_ssim(a, b) > 0.999
    return f"counts as alike: {cw_ssim(a, b):.4f}"


for _name, _scale in (("1e-12", 1e-12), ("1e12", 1e12)):

    @CASES.extreme(STAGE, f"one image times {_name}")
    def _exposed(scale: float = _scale) -> str:
        index = cw_ssim(_albedo(), scale * _albedo())
        assert abs(index - 1) < 1e-9
        return f"similarity 1 within {abs(index - 1):.0e}"


for _name, _fill, _says in (("black", 0.0, "mean 0 in its mask"), ("negative", -1.0, "mean -1 in its mask")):

    @CASES.extreme(STAGE, f"image {_name}", "named error")
    @naming(_says)
    def _black(fill: float = _fill) -> str:
        return str(cw_ssim(_albedo(), np.full((128, 128), fill)))


@CASES.extreme(STAGE, "images black, compared as they are")
def _black_as_it_is() -> str:
    index = cw_ssim(
        np.zeros((128, 128)), np.zeros((128, 128)), options=TemplateOptions(size=None, unit_mean=False)
    )
    assert index == 1
    return f"similarity {index}"


@CASES.extreme(STAGE, "image with a NaN in its mask", "named error")
@naming(r"image 0 \(ann\): 1 of 16384 pixels")
def _nan() -> str:
    image = _albedo().copy()
    image[5, 5] = math.nan
    return str(albedo_templates([image], ["ann"]).mask.sum())


@CASES.extreme(STAGE, "NaN outside the mask")
def _nan_outside() -> str:
    image, mask = _albedo().copy(), np.ones((128, 128), bool)
    mask[:20], image[:10] = False, math.nan
    index = cw_ssim(image, _albedo(), mask)
    assert abs(index - 1) < 0.02
    return f"similarity to itself {index:.4f}"


@CASES.extreme(STAGE, "image infinite", "named error")
@naming("the second image: 16384 of 16384 pixels")
def _infinite() -> str:
    return str(cw_ssim(_albedo(), np.full((128, 128), math.inf)))


@CASES.extreme(STAGE, "image of 1e300", "named error")
def _huge() -> str:
    return str(cw_ssim(_albedo(), 1e300 * (1 + 1e7 * _albedo())))


@CASES.extreme(STAGE, "image of one texel", "named error")
def _texel() -> str:
    return str(albedo_templates([np.ones((1, 1))], ["ann"], options=TemplateOptions(size=None)).mask.sum())


@CASES.extreme(STAGE, "image of 8 x 8, smaller than the pyramid", "named error")
def _small() -> str:
    return str(cw_ssim(np.ones((8, 8)), np.ones((8, 8))))


@CASES.extreme(STAGE, "image of 3 x 500", "named error")
def _strip() -> str:
    return str(cw_ssim(np.ones((3, 500)), np.ones((3, 500))))


@CASES.extreme(STAGE, "image smaller than the templates")
def _too_small() -> str:
    made = albedo_templates([_albedo(0, 64)], ["ann"])
    assert made.mask.shape == (1, 16, 16)
    return "stays as it is: 16 x 16 coefficients of 64 x 64 pixels"


@CASES.extreme(STAGE, "mask of one texel", "named error")
def _one_in_mask() -> str:
    mask = np.zeros((128, 128), bool)
    mask[64, 64] = True
    return str(albedo_templates([_albedo()], ["ann"], masks=[mask]).mask.sum())


@CASES.extreme(STAGE, "mask empty", "named error")
@naming("masked everywhere")
def _empty() -> str:
    return str(albedo_templates([_albedo()], ["ann"], masks=[np.zeros((128, 128), bool)]).mask.sum())


@CASES.extreme(STAGE, "masks that do not overlap", "named error")
@naming(r"template 0 \(ann\) and template 0 \(ann\): no window")
def _apart() -> str:
    left = np.zeros((128, 128), bool)
    left[:, :60] = True
    one, other = (albedo_templates([_albedo()], ["ann"], masks=[m]) for m in (left, left[:, ::-1]))
    return str(similarity_matrix(one, other))


@CASES.extreme(STAGE, "gallery of one")
def _alone() -> str:
    found = identify(_people(1), albedo_templates([_albedo(0)], ["person0"]))
    curve = cmc_curve(found)
    assert found.ranks.tolist() == [1]
    assert curve.rate.tolist() == [1.0]
    assert_finite(curve.low, curve.high)
    return f"rank 1, 95 % interval from {curve.low[0]:.3f}: one probe tells little"


@CASES.extreme(STAGE, "gallery of one, ROC", "named error")
@naming("one person only")
def _no_impostor() -> str:
    return str(roc_curve(identify(_people(1), albedo_templates([_albedo(0)], ["person0"]))).area)


@CASES.extreme(STAGE, "gallery of the same image for all")
def _twins() -> str:
    gallery = albedo_templates([_albedo(0)] * 3, ["ann", "bob", "cy"])
    found = identify(gallery, albedo_templates([_albedo(0)], ["ann"]))
    assert np.ptp(found.similarities) == 0
    assert found.ranks[0] == 3
    return "tied, and ranked last: no credit for what the alphabet decides"


@CASES.extreme(STAGE, "rows of a person duplicated")
def _duplicates() -> str:
    twice = _people().select([*range(len(_people()))] * 2)
    once, doubled = (identify(gallery, _probes()) for gallery in (_people(), twice))
    assert once.ranks.tolist() == doubled.ranks.tolist()
    np.testing.assert_array_equal(once.similarities, doubled.similarities)
    return f"ranks as without: {once.ranks.tolist()}"


@CASES.extreme(STAGE, "similarity NaN", "named error")
@naming(r"probe 0 \(ann\) and gallery image 1 \(bob\) is nan")
def _no_similarity() -> str:
    return str(identify_by_similarity(np.array([[0.5, math.nan]]), ["ann", "bob"], ["ann"]).ranks)


def _curves(similarities: Any, gallery: list[str], probes: list[str]) -> Identification:
    found = identify_by_similarity(np.asarray(similarities, float), gallery, probes)
    curve, roc = cmc_curve(found), roc_curve(found, resamples=50)
    assert_finite(curve.rate, curve.low, curve.high, roc.true_accept_rate, roc.low, roc.high)
    assert_finite(roc.area, roc.area_interval, roc.equal_error_rate, roc.equal_error_interval)
    assert curve.rate[-1] == 1
    return found


@CASES.extreme(STAGE, "all similarities equal")
def _all_equal() -> str:
    found = _curves(np.full((4, 4), 0.5), list("abcd"), list("abcd"))
    roc = roc_curve(found)
    assert found.rate(1) == 0
    assert abs(roc.area - 0.5) < 1e-12
    assert abs(roc.equal_error_rate - 0.5) < 1e-12
    return "rank 1 never, area 0.5, equal error 0.5: chance"


@CASES.extreme(STAGE, "all similarities right, and all wrong")
def _certain() -> str:
    areas = []
    for sign in (1, -1):
        found = _curves(sign * np.eye(4), list("abcd"), list("abcd"))
        areas.append(roc_curve(found, resamples=0).area)
    assert areas == [1.0, 0.0]
    return "areas 1 and 0"


@CASES.extreme(STAGE, "one probe alone, two persons, intervals")
def _one_probe() -> str:
    found = _curves([[0.9, 0.1]], ["ann", "bob"], ["ann"])
    return f"rank {found.ranks[0]}; resampling persons ends"


@CASES.extreme(STAGE, "only one person's probes, 200 persons")
def _lopsided() -> str:
    names = [f"p{k:03d}" for k in range(200)]
    scores = np.random.default_rng(0).random((1, 200))
    _curves(scores, names, names[:1])
    return "intervals of 50 resamples, each with that person"


@CASES.extreme(STAGE, "probes of 400 % noise", "measured warning")
def _noise() -> str:
    found = identify(_people(), _probes(4.0))
    curve = cmc_curve(found)
    assert curve.low[0] < 0.4
    return Measured(f"rate {curve.rate[0]:.2f}, 95 % interval {curve.low[0]:.2f} to {curve.high[0]:.2f}")


@CASES.extreme(STAGE, "an unnamed probe")
def _nobody() -> str:
    names = [None, "person1", None, "person3"]
    found = identify_by_similarity(similarity_matrix(_probes(), _people()), _people().names, names)
    assert found.predicted == ("person0", "person1", "person2", "person3")
    return "taken for the most similar person; no rate counts it"


for _wrong in (
    {"window": 0},
    {"window": math.nan},
):

    @CASES.extreme(STAGE, "similarity " + ", ".join(f"{k}={v}" for k, v in _wrong.items()), "named error")
    def _odd(wrong: dict[str, Any] = _wrong) -> str:
        return str(cw_ssim(_albedo(), _albedo(1), **wrong))


for _wrong in ({"size": math.nan}, {"size": 4}):

    @CASES.extreme(STAGE, "templates " + ", ".join(f"{k}={v}" for k, v in _wrong.items()), "named error")
    def _odder(wrong: dict[str, Any] = _wrong) -> str:
        return str(albedo_templates([_albedo()], ["ann"], options=TemplateOptions(**wrong)).mask.sum())
