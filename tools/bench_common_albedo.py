"""Error of one albedo from 1, 2, 4 and 8 photographs of a face, each under its own unknown flash.

Six people under single flashes (`../shared/data/yale`); the truth is photometric stereo over sixty flashes.
The error is 100 MSE / mean^2 on the texels that each photograph's flash reaches, mean over photographs;
beside it that of each photograph without its light, found together with the others'.

    tools/bench_common_albedo.py [--people N] [--draws N] [--counts 1,2,4,8]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from scan2albedo import GeometryImage
from scan2albedo.albedo import estimate_common_albedo

DATA = Path(__file__).parents[2] / "shared" / "data" / "yale"
AMBIENT = 0.06


def error(albedo: np.ndarray, truth: np.ndarray) -> float:
    """Return 100 MSE / mean square, best scale removed."""
    scale = (albedo * truth).sum() / (albedo**2).sum()
    return float(100 * ((scale * albedo - truth) ** 2).mean() / (truth**2).mean())


def photographs(person: dict[str, np.ndarray], chosen: np.ndarray) -> list[GeometryImage]:
    """Return photographs of a person as geometry images."""
    mask = person["mask"]
    grey = [np.where(mask, person["texture_linear8"][k] / 255.0, 0.0).astype(np.float32) for k in chosen]
    surface = person["position_mm"].astype(float), person["normal"].astype(float), mask
    return [GeometryImage(*surface, texture_linear=np.repeat(t[..., None], 3, -1)) for t in grey]


def reached(person: dict[str, np.ndarray], k: int) -> np.ndarray:
    """Return (H, W) the texels that flash k reaches."""
    facing = np.maximum(person["normal"].astype(float) @ person["direction"][k].astype(float), 0)
    flash = person["strength"][k] * facing
    lamp = (flash + AMBIENT) * person["albedo"].astype(float)
    alike = np.abs(person["texture_linear8"][k] / 255.0 / np.maximum(lamp, 1e-3) - 1) < 0.25
    return person["mask"] & (flash > 0.1) & alike


def main() -> None:
    """Print a row a person and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--counts", default="1,2,4,8")
    options = parser.parse_args()
    files = sorted(DATA.glob("*.npz"))[: options.people]
    if not files:
        raise SystemExit(f"{DATA} is missing: this benchmark needs the shared data")
    for count in map(int, options.counts.split(",")):
        rows = []
        for file in files:
            person = dict(np.load(file))
            truth, random = person["albedo"].astype(float), np.random.default_rng(count)
            for _ in range(options.draws):
                chosen = random.choice(len(person["lights"]), count, replace=False)
                start = time.process_time()
                found = estimate_common_albedo(photographs(person, chosen))
                spent = time.process_time() - start
                lit = [reached(person, k) for k in chosen]
                common = found.albedo_linear.max(-1).astype(float)
                own = [one.albedo_linear.max(-1).astype(float) for one in found.estimates]
                sees = [found.expected_error[on] for on in lit]
                scales = [np.median(truth[on]) / np.median(common[on]) for on in lit]
                true = [np.abs(s * common[on] / truth[on] - 1) for s, on in zip(scales, lit, strict=True)]
                rows.append(
                    [
                        np.mean([error(common[on], truth[on]) for on in lit]),
                        np.mean([error(one[on], truth[on]) for one, on in zip(own, lit, strict=True)]),
                        np.mean([np.mean(t < said) for t, said in zip(true, sees, strict=True)]),
                        np.median(np.concatenate(sees)),
                        spent,
                    ]
                )
                print(f"  {file.stem} {chosen.tolist()}: {np.round(rows[-1], 3)}", flush=True)
        table = np.array(rows)
        mean, worst = table.mean(0), table[:, 0].max()
        print(
            f"{count} photographs: common albedo {mean[0]:.2f} % (worst {worst:.2f}), each photograph's "
            f"{mean[1]:.2f} %; stated error {100 * mean[3]:.1f} %, holds {100 * mean[2]:.0f} %; "
            f"{mean[4]:.1f} s CPU",
            flush=True,
        )


if __name__ == "__main__":
    main()
