"""Raw synthetic scans whose pose, surface and correspondence are known; registration and fit share them."""

from dataclasses import dataclass, replace
from functools import cache, cached_property

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.registration import register
from scan2albedo.synthetic import Scanner, SyntheticTruth, raw_scan
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.sitter import compact

EXPRESSIONS: tuple[Expression, ...] = ("neutral", "smile", "surprise", "frown", "pout", "puff")
_PLAIN = Scanner(picture_size=48, size=128)
"""Small pictures: nothing here looks at colour."""
_NOISY = replace(_PLAIN, noise_mm=0.6, holes=20, spikes=100)
_COARSE = replace(_PLAIN, spacing_mm=5.0)
_BEYOND_MIDDLE_MM = 8.0
"""Half faces end this far beyond the middle."""
SCANNED_MM = 1.0
"""A scan this near to the true skin is of skin; hair lies farther out."""
_RIGID = slice(17, 48)
"""iBUG-68: brows, nose and eyes, which no expression moves far."""


@dataclass(frozen=True)
class ScanScene:
    """A raw scan in a random pose, and its truth."""

    scan: RawScan
    truth: SyntheticTruth
    model: AnnotatedFaceModel

    @cached_property
    def model_from_scan(self) -> FloatArray:
        """(4, 4) the pose that lays the person's brows, nose and eyes best on the model's.

        Two people's faces have no common pose of their own: this is a definition.
        """
        landmarks = self.model.landmarks
        assert landmarks is not None
        from_truth = procrustes(self.truth.landmarks[_RIGID], landmarks[_RIGID])
        return from_truth @ self.truth.model_from_scan

    @property
    def surface(self) -> FloatArray:
        """(N, 3) points of the true surface in the truth's frame, mm, without the film between the lips."""
        image = self.truth.image
        assert image.region is not None
        film = image.region == list(self.model.regions).index(MOUTH_REGION)
        return image.position[image.mask & ~film].astype(float)

    def scanned(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 3) of the true skin were scanned: not those under hair or in holes."""
        return scanned_skin(self.scan, self.truth, points)

    @cached_property
    def found_pose(self) -> FloatArray:
        """(4, 4) the pose that the registration finds: what the fit is given."""
        return register(self.scan, self.model).model_from_scan

    def limit_points(self, level: int) -> FloatArray:
        """Return the true places (V, 3) of the model's surface vertices of a level, in the truth's frame."""
        return self.model.subdivision(level).matrix @ self.truth.control_points


def scanned_skin(scan: RawScan, truth: SyntheticTruth, points: FloatArray) -> BoolArray:
    """Return which points (N, 3) of the true skin, in the truth's frame, have scan within `SCANNED_MM`."""
    raw = ClosestPointQuery(transform_points(truth.model_from_scan, scan.vertices), scan.faces)
    return raw.query(points).distance < SCANNED_MM


@cache
def scan_scenes(count: int, spacing_mm: float = 2.2) -> tuple[ScanScene, ...]:
    """Return scans of `count` people, each with another expression, in random poses."""
    options = replace(_PLAIN, spacing_mm=spacing_mm)
    return tuple(_scene(seed, options) for seed in range(count))


@cache
def hard_scan_scenes(count: int) -> tuple[ScanScene, ...]:
    """Return scans as `scan_scenes` does: in turn noisy ones full of holes, half faces, and coarse ones."""
    scenes = []
    for seed in range(count):
        options = (_NOISY, _PLAIN, _COARSE)[seed % 3]
        scene = _scene(10 + seed, options)
        scenes.append(_half(scene) if seed % 3 == 1 else scene)
    return tuple(scenes)


def _scene(seed: int, options: Scanner) -> ScanScene:
    model = AnnotatedFaceModel.default()
    expression = EXPRESSIONS[seed % len(EXPRESSIONS)]
    return ScanScene(*raw_scan(seed, expression=expression, model=model, scanner=options), model)


def _half(scene: ScanScene) -> ScanScene:
    """Return the scene with what lies beyond the middle of the face left out."""
    scan = scene.scan
    across = transform_points(scene.truth.model_from_scan, scan.vertices)[:, 0]
    kept = scan.faces[(across[scan.faces] > -_BEYOND_MIDDLE_MM).all(1)]
    half = RawScan(*compact(scan.vertices, kept), name=f"half of {scan.name}")
    return ScanScene(half, scene.truth, scene.model)
