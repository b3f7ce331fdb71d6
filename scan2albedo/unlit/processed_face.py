"""`ProcessedFace`: what the applications need of a processed scan, and whether faces share one chart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import EnvironmentLight, GeometryImage, PointLight
from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    Texts,
    Values,
    all_finite,
    attributes,
    brightest,
    on_grid,
)
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.io.glb import GlbPart
from scan2albedo.lighting.shading import Reflectance

if TYPE_CHECKING:
    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.fitting import FittedFace

NO_MODEL = "none"
OF_LIGHT = ("lights", "environment", "casts_shadows", "view_direction", "shadow_offset_mm")
"""Fields of a face that an `AlbedoEstimate`, and the record of a face, have by the same names."""
SAME_PLACE_MM = 0.05
"""Surfaces farther apart are not of one result, or of one model: GLB files hold metres with 24 bits."""
REACH_MM = 4.0
"""What lies farther from a surface has its shape from elsewhere."""
_LEAST_OVERLAP = 0.9
"""Part of the smaller mask that the other must contain for two charts to be the same."""


@dataclass(frozen=True)
class FaceMesh:
    """The surface behind a geometry image."""

    vertices: FloatArray
    """(V, 3): millimetres, in the frame of the geometry image."""
    faces: IntArray
    """(F, 3)."""
    uv: FloatArray
    """(V, 2): chart coordinates."""
    from_chart: bool = False
    """The texels themselves are the vertices (`GeometryImage.triangulated`)."""

    @classmethod
    def of_chart(cls, image: GeometryImage) -> Self:
        """Return the texel grid as a mesh, for images whose fitted surface is not known."""
        vertices, faces = image.triangulated()
        row, column = np.nonzero(image.mask)
        height, width = image.shape
        uv = np.stack([(column + 0.5) / width, 1 - (row + 0.5) / height], 1)
        return cls(vertices, faces, uv, from_chart=True)

    @cached_property
    def normals(self) -> FloatArray:
        """(V, 3) unit normals."""
        return vertex_normals(self.vertices, self.faces)

    def on_chart(self, values: FloatArray, mask: BoolArray) -> FloatArray:
        """Return (N, C) values of the masked texels from values (V, C) of the vertices."""
        if self.from_chart:
            return values
        return interpolate(rasterize_uv(self.uv, self.faces, mask.shape), self.faces, values)[mask]


@dataclass(frozen=True)
class Eyeball:
    """An eye behind its lids, in the frame of the face."""

    side: str
    """ "right" or "left", the subject's."""
    center_mm: FloatArray
    """(3,)."""
    radius_mm: float
    """Of the globe."""
    iris_mm: float
    """Radius of the iris."""
    gaze: FloatArray
    """(3,), unit: from the centre through the middle of the iris."""
    painted: bool
    """Whether the scan shows the eye; else its colours are usual ones, and it looks ahead."""
    rings_linear: FloatArray
    """(K, 3): albedo in steps of `eyes.RING_MM` away from the gaze, from the pupil to the white."""


@dataclass(frozen=True)
class EyesAndMouth:
    """What lies behind a face's openings."""

    eyes: tuple[Eyeball, ...]
    parts: tuple[GlbPart, ...]
    """`eyes`, and the mouth with its teeth."""
    cut_mm: FloatArray
    """(H, W): how far inside an opening texels of the chart are, below 0 where the face stays."""
    log_odds: FloatArray
    """(2, 2), right and left eye: that the scan shows it, and that it left it out, against shut lids."""
    reason: str
    """What was found or left out, and why; for people."""


@dataclass(frozen=True)
class ProcessedFace:
    """One processed scan, ready for applications; in the model's frame, mm.

    Raises `ApplicationError` when albedo and image differ in size, the albedo is negative or not finite on
    the surface, or the view direction is zero; `GeometryImageError` for normals of another length than 1.
    """

    name: str
    """For messages and files."""
    image: GeometryImage
    """Position, normal, mask, region, and the texture where there is one."""
    albedo_linear: Float32Array
    """(H, W, 3): zero outside the mask; known up to one global scale."""
    reflectance: Reflectance
    """How the skin reflects, its highlight in the albedo's unit."""
    lights: tuple[PointLight, ...]
    """Under which the scan was taken, beside its environment."""
    mesh: FaceMesh
    """The fitted surface, or the triangulated chart."""
    model_name: str = NO_MODEL
    """Of the face model whose chart this is; "none" for charts cut by xatlas."""
    casts_shadows: bool = True
    """Whether the surface shades itself."""
    view_direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Toward the viewer, for roughness and highlights on the chart."""
    shadow_offset_mm: float = 0.2
    """Of shadow rays."""
    environment: EnvironmentLight | None = None
    """The soft light of the scan; None is a white ambient light of 1."""
    has_albedo: bool = True
    """False for a shape alone: the albedo is then an even grey."""
    expected_error: Float32Array | None = None
    """(H, W): relative error of the albedo, see `AlbedoEstimate`; None where it is not known."""
    landmarks: FloatArray | None = None
    """(68, 3): iBUG-68 order; None where they are not known."""
    inside: EyesAndMouth | None = field(default=None, init=False)
    """What lies behind its openings, where `relight` looked for it; a copy with changes has it no more."""
    model: AnnotatedSurface | None = field(default=None, repr=False, compare=False)
    """Whose regions the image's are; the default model when None."""
    notes: Texts = ()
    """What was decided in making it, one sentence each."""

    def __post_init__(self) -> None:
        albedo, shape = np.asarray(self.albedo_linear, np.float32), self.image.shape
        everywhere = np.ones(shape, bool)
        for what, values, expected, where in (
            ("the albedo", albedo, (*shape, 3), self.mask),
            ("expected_error", self.expected_error, shape, everywhere),
            ("landmarks", self.landmarks, (68, 3), slice(None)),
        ):
            if values is not None and (values.shape != expected or not all_finite(values[where])):
                raise ApplicationError(
                    f"{self.name}: {what} is {values.shape} or holds NaN, expected finite numbers {expected} "
                    "like the geometry image; process the scan again"
                )
        if (lowest := float(albedo[self.image.mask].min(initial=0.0))) < 0:
            raise ApplicationError(f"{self.name}: the albedo goes down to {lowest:.3g}; albedo is 0 or more")
        if not (all_finite(self.view_direction) and np.any(self.view_direction)):
            raise ApplicationError(f"{self.name}: view_direction {self.view_direction} is not finite or zero")
        self.image.check_normals()
        if not len(self.mesh.faces):
            raise ApplicationError(f"{self.name}: the geometry image holds no surface")
        object.__setattr__(self, "albedo_linear", np.where(self.image.mask[..., None], albedo, 0))

    @classmethod
    def of(
        cls,
        name: str,
        image: GeometryImage,
        albedo_linear: ArrayLike,
        *,
        reflectance: Reflectance = Reflectance("lambert"),
        lights: Sequence[PointLight] = (),
        model_name: str = NO_MODEL,
    ) -> Self:
        """Return a face of a geometry image and its albedo (H, W, 3), from wherever they come.

        Parameters
        ----------
        name, image, albedo_linear : str, GeometryImage, (H, W, 3) array_like of float
        reflectance, lights, model_name : Reflectance, sequence of PointLight, str
        """
        albedo = np.asarray(albedo_linear, np.float32)
        return cls(name, image, albedo, reflectance, tuple(lights), FaceMesh.of_chart(image), model_name)

    @classmethod
    def of_stages(
        cls, name: str, image: GeometryImage, fitted: FittedFace | None, estimate: AlbedoEstimate | None
    ) -> Self:
        """Return the face that the stages found; a shape in grey where there is no albedo.

        Parameters
        ----------
        name, image, fitted, estimate : str, GeometryImage, FittedFace or None, AlbedoEstimate or None
        """
        found: Values = {"mesh": FaceMesh.of_chart(image)}
        if fitted is not None:
            found["mesh"] = FaceMesh(fitted.vertices, fitted.faces, fitted.uv)
            found |= {"model_name": fitted.model.name, "landmarks": fitted.landmarks}
        if estimate is None:
            return cls(name=name, image=image, **found, **cls.grey(image))
        found |= attributes(estimate, "albedo_linear", "reflectance", "expected_error", *OF_LIGHT)
        return cls(name=name, image=image, **found)

    @staticmethod
    def grey(image: GeometryImage) -> Values:
        """Return what a face of an `image` without an albedo has in its place."""
        grey = np.full((*image.shape, 3), 0.5, np.float32)
        return {
            "albedo_linear": grey,
            "reflectance": Reflectance("lambert"),
            "lights": (),
            "has_albedo": False,
        }

    @property
    def mask(self) -> BoolArray:
        """(H, W) texels of the surface."""
        return self.image.mask

    @property
    def bare(self) -> BoolArray:
        """(H, W) texels that were seen and are skin, as far as that is known."""
        return self.image.seen if self.image.skin is None else self.image.seen & (self.image.skin > 0.5)

    def level(self) -> float:
        """Return the albedo's level: the geometric mean of V over the texels whose texture was seen."""
        value = brightest(self.albedo_linear[self.image.seen])
        positive = value[value > 0]
        return float(np.exp(np.mean(np.log(positive, dtype=float)))) if len(positive) else 0.0

    def reshaped(self, mesh: FaceMesh, position: FloatArray, name: str) -> Self:
        """Return this face with other geometry: vertices of `mesh`, `position` (N, 3) of the masked texels.

        Normals are those of the new mesh plus the detail by which the image's differed from the old one's.

        Parameters
        ----------
        mesh, position, name : FaceMesh, (N, 3) float64, str
        """
        mask = self.image.mask
        old, new = (normalized(surface.on_chart(surface.normals, mask)) for surface in (self.mesh, mesh))
        normal = normalized(new + (self.image.normal[mask] - old))
        occluder = None if self.image.occluder is None or mesh.from_chart else (mesh.vertices, mesh.faces)
        position, normal = (on_grid(mask, values) for values in (position, normal))
        image = replace(self.image, position=position, normal=normal, occluder=occluder)
        landmarks = self.landmarks
        if landmarks is not None:
            nearest = cKDTree(self.mesh.vertices).query(landmarks)[1]
            landmarks = landmarks + mesh.vertices[nearest] - self.mesh.vertices[nearest]
        return replace(self, name=name, image=image, mesh=mesh, landmarks=landmarks)


def on_common_chart(
    *faces: ProcessedFace, model: AnnotatedSurface | None = None
) -> tuple[ProcessedFace, ...]:
    """Return the faces, of a `model` if given, on the texels that all have.

    ApplicationError names two whose charts differ.
    """
    if model is not None:
        faces = tuple(replace(face, model=model) for face in faces)
    a = faces[0]
    for b in faces[1:]:
        both = f"{a.name} and {b.name}"
        if a.image.shape != b.image.shape:
            sizes = " and ".join(f"{f.image.shape[1]} x {f.image.shape[0]}" for f in (a, b))
            raise ApplicationError(f"{both}: geometry images of {sizes} texels; process both with one --size")
        if a.model_name != b.model_name:
            raise ApplicationError(
                f"{both}: processed with different models, {a.model_name!r} and {b.model_name!r}; "
                "process both scans with one --model"
            )
        # The same triangles at the same places of the chart, to 24 bits.
        one, two = a.mesh, b.mesh
        same_triangles = len(one.uv) == len(two.uv) and np.array_equal(one.faces, two.faces)
        if same_triangles and np.allclose(one.uv, two.uv, rtol=0, atol=1e-5):
            continue
        if a.model_name == NO_MODEL:
            raise ApplicationError(
                f"{both}: processed without a model, so each has its own chart and texels do not correspond; "
                "process both scans with a model"
            )
        overlap = (a.mask & b.mask).sum() / min(a.mask.sum(), b.mask.sum())
        if not (a.mesh.from_chart and b.mesh.from_chart and overlap >= _LEAST_OVERLAP):
            raise ApplicationError(
                f"{both}: their charts differ although both name the model {a.model_name!r}; "
                "process both scans again with one version of it"
            )
    mask, restricted = np.logical_and.reduce([face.mask for face in faces]), []
    if all(np.array_equal(face.mask, mask) for face in faces):
        return faces
    for face in faces:
        old = face.image
        image = replace(
            old,
            mask=mask,
            position=np.where(mask[..., None], old.position, 0),
            normal=np.where(mask[..., None], old.normal, 0),
            region=None if old.region is None else np.where(mask, old.region, 255),
        )
        restricted.append(replace(face, image=image, mesh=FaceMesh.of_chart(image)))
    return tuple(restricted)
