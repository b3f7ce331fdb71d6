"""Rays through lenses and the scene behind them; lenses in the rims of synthetic frames."""

import numpy as np
import pytest
from helpers.measures import row_lengths
from helpers.plates import plate
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import LensMaterial
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens, insert_lens, lens_mesh, trace_lenses
from scan2albedo.eyeglasses.lenses.optics import ThinLens, mirror_on_sphere, refract
from scan2albedo.eyeglasses.lenses.rims import LensRim
from scan2albedo.eyeglasses.lenses.scenes import LensScene
from scan2albedo.eyeglasses.mean_keypoints import BEHIND
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses

CAMERA = np.array([3.0, -5, 600])


def round_lens(material, z=0.0, side=0, bulge=0.0):
    """A lens of 60 mm across the z axis; `bulge` lifts its rim off the plane at two sides."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = np.column_stack([30 * np.cos(angle), 30 * np.sin(angle), z + bulge * np.cos(2 * angle)])
    center, normal = np.array([0, 0, z]), np.array([0, 0, 1.0])
    mesh = lens_mesh(center, rim, normal)
    outline = LensRim(rim, np.ones(64, bool), "none", center, normal)
    optics = ThinLens(center, normal, material.dioptres)
    return InsertedLens(side, material, outline, *mesh, optics, RayCaster(*mesh))


def trace(lenses, through, camera=CAMERA, wall_z=-30.0):
    """Paths of rays from a camera through points to a wall."""
    scene = LensScene(plate(500.0, wall_z), ())
    return trace_lenses(scene, lenses, scene.rays(np.array(camera, float), normalized(through - camera)))


def disc(count=200, radius=29.0):
    """Points in the plane z = 0."""
    rng = np.random.default_rng(0)
    along = np.exp(1j * rng.uniform(0, 2 * np.pi, count)) * radius * np.sqrt(rng.random(count))
    return np.column_stack([along.real, along.imag, np.zeros(count)])


@pytest.mark.parametrize("dioptres", [-20.0, -0.25, 0, 20])
def test_a_flat_lens_refracts(dioptres):
    lens = round_lens(LensMaterial(dioptres=dioptres), side=1)
    paths = trace([lens], disc())
    expected = refract(lens.optics, CAMERA, disc())
    assert_allclose(paths.rays.directions, expected.directions, atol=1e-6)
    assert (paths.first == 1).all()
    assert paths.bent.all() == (dioptres != 0)
    assert_allclose(paths.rays.ends[:, 2], -30, atol=1e-9)


def test_lenses_in_a_row_are_the_lens_of_gullstrand():
    """The power of two thin lenses d apart is P1 + P2 - d P1 P2, from the cardinal points of optics."""
    first = 6.0
    second = -4.0
    gap = 0.012
    lenses = [round_lens(LensMaterial(second), -1000 * gap), round_lens(LensMaterial(first), side=1)]
    # Rays from far away, parallel to the axis: all meet the axis at the back focal length.
    paths = trace(lenses, disc(radius=20), [0, 0, 1e7], wall_z=-700)
    power = first + second - gap * first * second
    back_focus = -1000 * gap - 1000 * (1 - gap * first) / power
    at = (back_focus - paths.rays.origins[:, 2]) / paths.rays.directions[:, 2]
    meet = paths.rays.origins + at[:, None] * paths.rays.directions
    assert (paths.first == 1).all()
    assert np.abs(meet[:, :2]).max() < 0.01


def test_a_ray_passes_every_lens_once_and_shares_multiply():
    a = LensMaterial(dioptres=-1, tint_linear=(0.4, 0.1, 0), alpha=0.3, beta=0.1)
    b = LensMaterial(dioptres=2, tint_linear=(0.5, 0.25, 1), alpha=0.5, beta=0.2, tinting="filter")
    paths = trace([round_lens(a), round_lens(b, -10.0, side=1)], disc(50, radius=20))
    through_b = 0.3 + 0.5 * np.array([0.5, 0.25, 1])
    assert_allclose(paths.share, np.tile(0.6 * through_b, (50, 1)), rtol=1e-12)
    front, back = paths.crossings
    assert_allclose(front.tint_share, 0.3, rtol=1e-12)
    assert_allclose(front.mirror_share, 0.1, rtol=1e-12)
    assert_allclose(back.mirror_share, 0.6 * 0.2, rtol=1e-12)
    assert not back.tint_share.any()


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 0.04), (0.6, 0.4), (0.0, 1.0), (0.5, 0.0)])
def test_fresnel_keeps_the_light_together_and_grows_towards_the_edge(alpha, beta):
    lens = round_lens(LensMaterial(alpha=alpha, beta=beta, fresnel=True))
    straight = trace([lens], np.zeros((1, 3)), [0, 0, 600])
    assert_allclose(straight.crossings[0].mirror_share, beta, atol=1e-12)
    slanting = trace([lens], disc(50), [600, 0, 40])
    crossing = slanting.crossings[0]
    assert_allclose(slanting.share + crossing.tint_share + crossing.mirror_share, 1, rtol=1e-12)
    assert (crossing.mirror_share >= beta).all()
    assert beta == 1 or crossing.mirror_share.min() > beta + 0.15 * (1 - beta)


def test_the_sphere_mirrors_as_spheres_do():
    rng, axis = np.random.default_rng(0), np.array([0.0, 0, 1])
    center = np.array([30.0, 0, 5])
    outward = normalized(rng.normal(size=(50, 3)) + 4 * axis)
    incoming = normalized(rng.normal(size=outward.shape)) - 2 * outward
    # Points in the lens's plane stand for those of the sphere, of 80 mm, along its radius.
    points = center + 80 * (outward / outward[:, 2:] - axis)
    got, heading = mirror_on_sphere(points, incoming, center, axis, 80.0), normalized(incoming)
    along = (heading * outward).sum(1, keepdims=True)
    assert_allclose(got, heading - 2 * along * outward, atol=1e-12)
    flat = mirror_on_sphere(points, incoming, center, 2 * axis, np.inf)
    assert_allclose(flat, heading * [1, 1, -1], atol=1e-15)


def test_what_lies_before_the_lens_hides_it():
    paths = trace([round_lens(LensMaterial(dioptres=-8))], disc(), wall_z=10)
    assert (paths.first == -1).all()
    assert not paths.bent.any()
    assert (paths.share == 1).all()


def test_rays_along_the_plane_are_counted_and_left_alone():
    lens = round_lens(LensMaterial(dioptres=20, beta=0.5), bulge=2.0)
    camera = np.array([0.0, 600, 1e-4])
    through = np.linspace([-25, 0, 1e-4], [25, 0, 1e-4])
    paths = trace([lens], through, camera)
    met = lens.caster.first_hit(np.tile(camera, (50, 1)), through - camera).face >= 0
    assert paths.glancing == met.sum() > 40
    assert not paths.bent.any()
    assert (paths.share == 1).all()
    assert paths.crossings == []


def test_rays_bend_where_they_meet_a_lens_that_is_not_flat():
    """Rays through the same point of a curved lens from two sides bend as by one thin lens through it."""
    lens = round_lens(LensMaterial(dioptres=10), bulge=3.0)
    for camera in ([500.0, 0, 60], [-500.0, 30, 60]):
        paths = trace([lens], disc(100), camera)
        rays = paths.rays.chosen(paths.bent)
        assert len(rays.origins) > 50
        assert np.abs(rays.origins[:, 2]).max() > 1
        for start, direction in zip(rays.origins, rays.directions, strict=True):
            thin = ThinLens([0, 0, start[2]], [0, 0, 1], 10)
            assert_allclose([direction], refract(thin, camera, start[None]).directions, atol=1e-9)


def lens_of(glasses, side=0, scale=1.0, keypoints=None, **options):
    marks = glasses.keypoints if keypoints is None else keypoints
    mesh = scale * glasses.vertices, glasses.faces
    return insert_lens(*mesh, scale * marks, side, LensMaterial(), **options)


@pytest.mark.parametrize("bend", [GlassesBend(), GlassesBend(8, 2, 4)])
@pytest.mark.parametrize("side", [0, 1])
def test_lenses_sit_in_their_rims(bend, side):
    for seed in range(4):
        glasses = eyeglasses(seed, bend=bend)
        middle = glasses.lens_centers[side]
        lens = lens_of(glasses, side, seat_mm=0.3)
        center, normal = lens.optics.center, lens.optics.normal
        assert np.linalg.norm(center - middle) < 2.5
        assert normal[2] > 0.9
        inner = row_lengths(lens.rim.points - lens.rim.center)
        seated = row_lengths(lens.vertices[1:] - lens.rim.center)
        assert_allclose((seated - inner)[lens.rim.measured], 0.295, atol=0.015)
        pupil = middle + [4.0, -3, 5]
        moved = lens_of(glasses, side, center=pupil, seat_mm=0.3)
        assert_allclose(np.cross(moved.optics.center - pupil, normal), 0, atol=1e-9)
        assert abs((moved.optics.center - center) @ normal) < 1e-9
        assert_array_equal(moved.vertices, lens.vertices)


def test_the_centre_is_the_centroid_and_front_is_away_from_the_temples():
    glasses = eyeglasses(1, shape=GlassesShape(wrap_radius=1e9))
    lens = lens_of(glasses)
    assert np.linalg.norm(lens.optics.center - glasses.lens_centers[0]) < 0.3
    rims = np.array(["_rim_" in name for name in glasses.names])
    rims_only = np.where(rims[:, None], glasses.keypoints, np.nan)
    assert lens_of(glasses, keypoints=rims_only).optics.normal @ lens.optics.normal > 0.999
    # The temples' key points tell the front, whatever else there is.
    reversed_ = glasses.keypoints
    reversed_[BEHIND, 2] *= -1
    assert lens_of(glasses, keypoints=reversed_).optics.normal @ lens.optics.normal < -0.999


def test_what_holds_no_lens_is_named():
    glasses = eyeglasses(2)
    marks = glasses.keypoints
    marks[glasses.names.index("right_rim_top")] = np.nan
    assert lens_of(glasses, keypoints=marks).name == "left lens"

    def refused(words, *given, **changes):
        with pytest.raises(EyeglassesError, match=words):
            lens_of(glasses, *given, **changes)

    refused(r"the right lens needs .* right_rim_top is missing", 1, keypoints=marks)
    marks[glasses.names.index("right_rim_outer"), 1] = np.inf
    refused("right_rim_top, right_rim_outer are missing", 1, keypoints=marks)
    for scale in (1e-3, 1e3):
        refused(r"the left lens: .* millimetres", scale=scale)
    refused(r"the left lens: .* one line", keypoints=glasses.keypoints * [1, 0, 0])


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        ({"dioptres": np.nan}, EyeglassesError),
        ({"tint_linear": (np.nan, 0, 0)}, EyeglassesError),
        ({"tint_linear": (-0.1, 0, 0)}, EyeglassesError),
        ({"alpha": 0.7, "beta": 0.4}, EyeglassesError),
        ({"alpha": -0.1}, EyeglassesError),
        ({"alpha": np.nan}, EyeglassesError),
        ({"front_radius_mm": 0.0}, EyeglassesError),
        ({"tint_linear": (1.1, 0, 0), "tinting": "filter"}, EyeglassesError),
        ({"tint_linear": (1, 1)}, ValueError),
        ({"tinting": "glow"}, ValueError),
    ],
)
def test_materials_that_cannot_be_are_refused(wrong, kind):
    with pytest.raises(kind, match=next(iter(wrong)).split("_")[0]):
        LensMaterial(**wrong)


def test_transmission_is_what_is_left():
    assert LensMaterial().transmission.tolist() == [1, 1, 1]
    assert LensMaterial().clear
    tint = {"tint_linear": (1, 0.5, 0), "alpha": 0.5, "beta": 0.25}
    assert LensMaterial(**tint).transmission.tolist() == [0.25] * 3
    assert LensMaterial(**tint, tinting="filter").transmission.tolist() == [0.75, 0.5, 0.25]
    assert not LensMaterial(fresnel=True).clear
