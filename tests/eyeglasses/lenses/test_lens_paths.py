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
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses

CAMERA = np.array([3.0, -5, 600])


def round_lens(side, material, z, radius=30.0, bulge=0.0):
    """A lens across the z axis; `bulge` lifts its rim off the plane at two sides."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    height = z + bulge * np.cos(2 * angle)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    center, normal = np.array([0, 0, z]), np.array([0, 0, 1.0])
    vertices, faces = lens_mesh(center, rim, normal)
    outline = LensRim(rim, np.ones(64, bool), "none", center, normal)
    optics = ThinLens(center, normal, material.dioptres)
    return InsertedLens(side, material, outline, vertices, faces, optics, RayCaster(vertices, faces))


def wall(z=-30.0):
    return LensScene(plate(500.0, z), ())


def trace(scene, lenses, through, camera=CAMERA):
    return trace_lenses(scene, lenses, scene.rays(camera, normalized(through - camera)))


def disc(count=200, radius=29.0):
    rng = np.random.default_rng(0)
    r, angle = radius * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.zeros(count)])


@pytest.mark.parametrize("dioptres", [-20.0, -0.25, 0, 20])
def test_a_flat_lens_refracts(dioptres):
    lens = round_lens(1, LensMaterial(dioptres=dioptres), 0.0)
    through = disc()
    paths = trace(wall(), [lens], through)
    expected = refract(lens.optics, CAMERA, through)
    assert_allclose(paths.rays.directions, expected.directions, atol=1e-6)
    assert (paths.first == 1).all()
    assert paths.bent.all() == (dioptres != 0)
    assert_allclose(paths.rays.ends[:, 2], -30, atol=1e-9)


def test_lenses_in_a_row_are_the_lens_of_gullstrand():
    """The power of two thin lenses d apart is P1 + P2 - d P1 P2, from the cardinal points of optics."""
    first = 6.0
    second = -4.0
    gap = 0.012
    places = (second, -1000 * gap), (first, 0.0)
    lenses = [round_lens(side, LensMaterial(dioptres=power), z) for side, (power, z) in enumerate(places)]
    # Rays from far away, parallel to the axis: all meet the axis at the back focal length.
    paths = trace(wall(z=-700), lenses, disc(radius=20), camera=np.array([0.0, 0, 1e7]))
    power = first + second - gap * first * second
    back_focus = -1000 * gap - 1000 * (1 - gap * first) / power
    at = (back_focus - paths.rays.origins[:, 2]) / paths.rays.directions[:, 2]
    meet = paths.rays.origins + at[:, None] * paths.rays.directions
    assert (paths.first == 1).all()
    assert np.abs(meet[:, :2]).max() < 0.01


def test_a_ray_passes_every_lens_once_and_shares_multiply():
    a = LensMaterial(dioptres=-1, tint_linear=(0.4, 0.1, 0), alpha=0.3, beta=0.1)
    b = LensMaterial(dioptres=2, tint_linear=(0.5, 0.25, 1), alpha=0.5, beta=0.2, tinting="filter")
    lenses = [round_lens(0, a, 0.0), round_lens(1, b, -10.0)]
    paths = trace(wall(), lenses, disc(50, radius=20))
    through_b = 0.3 + 0.5 * np.array([0.5, 0.25, 1])
    assert_allclose(paths.share, np.tile(0.6 * through_b, (50, 1)), rtol=1e-12)
    front, back = paths.crossings
    assert_allclose(front.tint_share, 0.3, rtol=1e-12)
    assert_allclose(front.mirror_share, 0.1, rtol=1e-12)
    assert_allclose(back.mirror_share, 0.6 * 0.2, rtol=1e-12)
    assert not back.tint_share.any()


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 0.04), (0.6, 0.4), (0.0, 1.0), (0.5, 0.0)])
def test_fresnel_keeps_the_light_together_and_grows_towards_the_edge(alpha, beta):
    lens = round_lens(0, LensMaterial(alpha=alpha, beta=beta, fresnel=True, tint_linear=(1, 1, 1)), 0.0)
    straight = trace(wall(), [lens], np.zeros((1, 3)), camera=np.array([0.0, 0, 600]))
    assert_allclose(straight.crossings[0].mirror_share, beta, atol=1e-12)
    slanting = trace(wall(), [lens], disc(50), camera=np.array([600.0, 0, 40]))
    crossing = slanting.crossings[0]
    total = slanting.share + crossing.tint_share + crossing.mirror_share
    assert_allclose(total, 1, rtol=1e-12)
    assert (crossing.mirror_share >= beta).all()
    assert beta == 1 or crossing.mirror_share.min() > beta + 0.15 * (1 - beta)


def test_the_sphere_mirrors_as_spheres_do():
    rng, axis = np.random.default_rng(0), np.array([0.0, 0, 1])
    center = np.array([30.0, 0, 5])
    radius = 80.0
    outward = normalized(rng.normal(size=(500, 3)))
    outward = outward[outward[:, 2] > 0.9]
    incoming = normalized(rng.normal(size=outward.shape)) - 2 * outward
    # Points in the lens's plane stand for those of the sphere along its radius.
    points = center - radius * axis + outward * (radius / outward[:, 2])[:, None]
    got, heading = mirror_on_sphere(points, incoming, center, axis, radius), normalized(incoming)
    assert_allclose((got * outward).sum(1), -(heading * outward).sum(1), atol=1e-12)
    assert_allclose(np.cross(got - heading, outward), 0, atol=1e-12)
    flat = mirror_on_sphere(points, incoming, center, 2 * axis, np.inf)
    assert_allclose(flat, heading * [1, 1, -1], atol=1e-15)


def test_what_lies_before_the_lens_hides_it():
    lens = round_lens(0, LensMaterial(dioptres=-8), 0.0)
    paths = trace(wall(z=10), [lens], disc())
    assert (paths.first == -1).all()
    assert not paths.bent.any()
    assert (paths.share == 1).all()


def test_rays_along_the_plane_are_counted_and_left_alone():
    lens = round_lens(0, LensMaterial(dioptres=20, beta=0.5), 0.0, bulge=2.0)
    camera = np.array([0.0, 600, 1e-4])
    through = np.column_stack([np.linspace(-25, 25, 50), np.zeros(50), np.full(50, 1e-4)])
    paths = trace(wall(), [lens], through, camera=camera)
    met = lens.caster.first_hit(np.tile(camera, (50, 1)), through - camera).face >= 0
    assert paths.glancing == met.sum() > 40
    assert not paths.bent.any()
    assert (paths.share == 1).all()
    assert paths.crossings == []


def test_rays_bend_where_they_meet_a_lens_that_is_not_flat():
    """Rays through the same point of a curved lens from two sides bend as by one thin lens through it."""
    lens = round_lens(0, LensMaterial(dioptres=10), 0.0, bulge=3.0)
    for camera in ([500.0, 0, 60], [-500.0, 30, 60]):
        paths = trace(wall(), [lens], disc(100), camera=np.array(camera))
        met = paths.bent
        assert met.sum() > 50
        assert np.abs(paths.rays.origins[met, 2]).max() > 1
        for start, direction in zip(paths.rays.origins[met], paths.rays.directions[met], strict=True):
            thin = ThinLens([0, 0, start[2]], [0, 0, 1], 10)
            expected = refract(thin, camera, start[None]).directions[0]
            assert_allclose(direction, expected, atol=1e-9)


def lens_of(glasses, side=0, keypoints=None, **options):
    marks = glasses.keypoints if keypoints is None else keypoints
    return insert_lens(glasses.vertices, glasses.faces, marks, side, LensMaterial(), **options)


@pytest.mark.parametrize("bend", [GlassesBend(), GlassesBend(8, 2, 4)])
def test_lenses_sit_in_their_rims(bend):
    for seed in range(4):
        glasses = eyeglasses(seed, bend=bend)
        for side in range(2):
            lens = lens_of(glasses, side, seat_mm=0.3)
            off = np.asarray(lens.optics.center) - glasses.lens_centers[side]
            assert np.linalg.norm(off) < 2.5
            assert lens.optics.normal[2] > 0.9
            inner = row_lengths(lens.rim.points - lens.rim.center)
            seated = row_lengths(lens.vertices[1:] - lens.rim.center)
            assert_allclose((seated - inner)[lens.rim.measured], 0.295, atol=0.015)
            pupil = glasses.lens_centers[side] + [4.0, -3, 5]
            moved = lens_of(glasses, side, center=pupil, seat_mm=0.3)
            offset = moved.optics.center - pupil
            assert np.linalg.norm(np.cross(offset, moved.optics.normal)) < 1e-9
            assert abs((moved.optics.center - lens.optics.center) @ moved.optics.normal) < 1e-9
            assert_array_equal(moved.vertices, lens.vertices)


def test_the_centre_is_the_centroid_and_front_is_away_from_the_temples():
    glasses = eyeglasses(1, shape=GlassesShape(wrap_radius=1e9))
    lens = lens_of(glasses)
    assert np.linalg.norm(lens.optics.center - glasses.lens_centers[0]) < 0.3
    rims_only = glasses.keypoints.copy()
    rims_only[[i for i, n in enumerate(glasses.names) if "_rim_" not in n]] = np.nan
    assert lens_of(glasses, keypoints=rims_only).optics.normal @ lens.optics.normal > 0.999
    # The temples' key points tell the front, whatever else there is.
    reversed_ = glasses.keypoints.copy()
    behind = [i for i, n in enumerate(glasses.names) if "_rim_" not in n and "bridge" not in n]
    reversed_[behind, 2] *= -1
    assert lens_of(glasses, keypoints=reversed_).optics.normal @ lens.optics.normal < -0.999


def test_what_holds_no_lens_is_named():
    glasses = eyeglasses(2)
    marks = glasses.keypoints.copy()
    marks[glasses.names.index("right_rim_top")] = np.nan
    with pytest.raises(EyeglassesError, match=r"the right lens needs .* right_rim_top is missing"):
        lens_of(glasses, 1, keypoints=marks)
    assert lens_of(glasses, keypoints=marks).name == "left lens"
    marks[glasses.names.index("right_rim_outer"), 1] = np.inf
    with pytest.raises(EyeglassesError, match="right_rim_top, right_rim_outer are missing"):
        lens_of(glasses, 1, keypoints=marks)
    for scale in (1e-3, 1e3):
        with pytest.raises(EyeglassesError, match=r"the left lens: .* millimetres"):
            insert_lens(scale * glasses.vertices, glasses.faces, scale * marks, 0, LensMaterial())
    flat = glasses.keypoints.copy()
    flat[:, 1:] = 0
    with pytest.raises(EyeglassesError, match=r"the left lens: .* one line"):
        lens_of(glasses, keypoints=flat)


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
    painted = LensMaterial(tint_linear=(1, 1, 1), alpha=0.25, beta=0.25)
    assert painted.transmission.tolist() == [0.5] * 3
    dyed = LensMaterial(tint_linear=(1, 0.5, 0), alpha=0.5, beta=0.25, tinting="filter")
    assert dyed.transmission.tolist() == [0.75, 0.5, 0.25]
    assert not LensMaterial(fresnel=True).clear
