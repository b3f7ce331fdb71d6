"""Identify persons by their albedo, and by the texture as it was photographed.

    python examples/identify_gallery.py [-o OUT] [--persons 4] [--size 128]

Every synthetic person is pictured twice, under lamps on opposite sides; the albedo is estimated from either
picture. The shapes are the true ones, so texels correspond exactly, which those of fitted scans do not: the
figures show how it is done, not how well it works. For processed scans there is `scan2albedo identify`, or
`recognition.identify_results`. Takes a second a picture.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import scan2albedo as s2a
from scan2albedo.recognition import Templates

GALLERY_LIGHT, PROBE_LIGHT = s2a.synthetic.light_at(-45, 20), s2a.synthetic.light_at(50, 0)


def templates(light: s2a.PointLight, persons: int, size: int) -> tuple[Templates, Templates]:
    """Return the templates of all persons' albedos, and of their textures, under one lamp."""
    images = [s2a.synthetic.face(seed, lights=[light], size=size).image for seed in range(persons)]
    albedos = [s2a.estimate_albedo(image, lights=1).albedo_linear for image in images]
    textures = [image.texture_linear for image in images]
    names, seen = [f"person-{seed}" for seed in range(persons)], [image.seen for image in images]
    options = s2a.recognition.TemplateOptions(size=size)
    of_albedos, of_textures = (
        s2a.recognition.albedo_templates(pictures, names, masks=seen, options=options)
        for pictures in (albedos, textures)
    )
    return of_albedos, of_textures


def main(arguments: Sequence[str] | None = None) -> None:
    """Write gallery.npz and print who is taken for whom."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("example_out"))
    parser.add_argument("--persons", type=int, default=4)
    parser.add_argument("--size", type=int, default=128)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)

    galleries = templates(GALLERY_LIGHT, given.persons, given.size)
    probes = templates(PROBE_LIGHT, given.persons, given.size)
    s2a.recognition.write_templates(given.out / "gallery.npz", galleries[0])

    for what, gallery, probe in zip(("albedo", "texture"), galleries, probes, strict=True):
        found = s2a.recognition.identify(gallery, probe)
        print(f"by {what}: {found.rate(1):.0%} right at rank 1")
        for name, predicted, similarity in zip(
            found.probe_names, found.predicted, found.similarities.max(axis=1), strict=True
        ):
            print(f"  {name} taken for {predicted}, similarity {similarity:.3f}")


if __name__ == "__main__":
    main()
