"""Extremes of recognition: templates, complex wavelet similarity, identification and its curves."""

import math
from functools import cache

import numpy as np
from helpers.albedo_fields import build_albedo

from scan2albedo.recognition import (
    TemplateOptions,
    albedo_templates,
    cmc_curve,
    cw_ssim,
    identify,
    identify_by_similarity,
    roc_curve,
)
from stability.case import below, each, measured, refuses, right, table, warns
from stability.scenes import with_one

SHAPE = (128, 128)
albedo = cache(build_albedo)


def templates(*images, **options):
    """Return the templates of images of persons a, b, c ..., albedos 0, 1, 2 ... by default."""
    return albedo_templates(images, list("abcdefgh"[: len(images)]), **options)


def everywhere(value):
    """Return an image of one value."""
    return np.full(SHAPE, value)


def like(image, **options):
    """Return the similarity of an albedo to an image."""
    return cw_ssim(albedo(0), image, **options)


def unlike(image, other):
    """Return how far two images are from being alike."""
    return abs(cw_ssim(image, other) - 1)


def wall():
    """Return the rank of a person in a gallery with a wall, and the similarities of both."""
    found = identify(templates(albedo(0), everywhere(1.0)), templates(albedo(0)))
    return found.ranks[0], *found.similarities[0].round(3)


def one_person():
    """Identify the only person of a gallery."""
    return identify(templates(albedo(0)), templates(albedo(0)))


def alone():
    """Return the rank of the only person of a gallery, the rate's interval and the curve."""
    found = one_person()
    curve = cmc_curve(found)
    assert curve.rate.tolist() == [1.0]
    return found.ranks[0], curve.low[0], curve


def curves(similarities, gallery, probes):
    """Return both curves of similarities, and how far the area under the second is from chance."""
    found = identify_by_similarity(np.asarray(similarities, float), list(gallery), list(probes))
    roc = roc_curve(found, resamples=50)
    return abs(roc.area - 0.5) + abs(roc.equal_error_rate - 0.5), found.rate(1), roc, cmc_curve(found)


def noisy():
    """Return the rate of probes of 400 % noise, and its interval, which says how little that tells."""
    rng = np.random.default_rng(9)
    seen = templates(*(albedo(k) + 4.0 * rng.standard_normal(SHAPE) for k in range(4)))
    curve = cmc_curve(identify(templates(*map(albedo, range(4))), seen))
    assert curve.low[0] < 0.4
    return curve.rate[0], curve.low[0], curve.high[0]


CASES = table(
    "recognition",
    right(
        below(1e-3, "similarity 1 within {:.0e}"),
        {
            "constant images": lambda: unlike(everywhere(0.5), everywhere(0.2)),
            "images of contrast 1e-9": lambda: unlike(1 + 1e-9 * albedo(0), 1 + 1e-9 * albedo(1)),
            **each(
                "one image times {}", ("1e-12", "1e12"), lambda scale: unlike(albedo(0), scale * albedo(0))
            ),
            "images black, compared as they are": lambda: (
                1
                - cw_ssim(
                    everywhere(0.0), everywhere(0.0), options=TemplateOptions(size=None, unit_mean=False)
                )
            ),
        },
    ),
    right(below(0.5, "similarity {:.3f}"), "a constant image and an albedo", lambda: like(everywhere(0.5))),
    right(below(2, "rank {}, similarities {:.3f} and {:.3f}"), "constant image in a gallery", wall),
    refuses("mean 0 in its mask", "image black", lambda: like(everywhere(0.0))),
    refuses("mean -1 in its mask", "image negative", lambda: like(everywhere(-1.0))),
    refuses(
        r"image 0 \(a\): 1 of 16384 pixels",
        "image with a NaN in its mask",
        lambda: templates(with_one(albedo(0), math.nan, (5, 5))),
    ),
    refuses("16384 of 16384 pixels", "image infinite", lambda: like(everywhere(math.inf))),
    refuses(
        "",
        {
            "image of 1e300": lambda: like(1e300 * (1 + 1e7 * albedo(0))),
            "image of one texel": lambda: templates(np.ones((1, 1)), options=TemplateOptions(size=None)),
            **each(
                "image of {}",
                {"8 x 8, smaller than the pyramid": np.ones((8, 8)), "3 x 500": np.ones((3, 500))},
                lambda image: cw_ssim(image, image),
            ),
            "mask of one texel": lambda: templates(
                albedo(0), masks=[with_one(everywhere(False), True, (5, 5))]
            ),
            "similarity window=nan": lambda: like(albedo(1), window=math.nan),
            "templates size=4": lambda: templates(albedo(0), options=TemplateOptions(size=4)),
        },
    ),
    refuses("masked everywhere", "mask empty", lambda: templates(albedo(0), masks=[everywhere(False)])),
    right(below(2, "rank {}, 95 % interval from {:.3f}: one probe tells little"), "gallery of one", alone),
    refuses(
        "one person only",
        "gallery of one, ROC",
        lambda: roc_curve(one_person()),
    ),
    right(
        below(1e-12, "{:.0e} from chance, right {:.0%}"),
        "all similarities equal",
        lambda: curves(np.full((4, 4), 0.5), "abcd", "abcd"),
    ),
    right(
        below(1.5, "intervals of 50 resamples: {1:.0%} right"),
        {
            "one probe alone, two persons": lambda: curves([[0.9, 0.1]], "ab", "a"),
            "only one person's probes, 200 persons": lambda: curves(
                np.random.default_rng(0).random((1, 200)), map("p{:03d}".format, range(200)), ["p000"]
            ),
        },
    ),
    warns(measured("rate {:.2f}, 95 % interval {:.2f} to {:.2f}"), "probes of 400 % noise", noisy),
)
