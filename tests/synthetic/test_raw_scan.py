import numpy as np
import pytest
from helpers.measures import row_lengths
from helpers.square import sample
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_vertex_mask, normalized, vertex_components
from scan2albedo.geometry.parametrization import boundary_loop
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic import Material, Scanner, light_at, raw_scan
from scan2albedo.synthetic.raw_scan import flash_pictures, two_pods
from scan2albedo.synthetic.renderer import incident_light
from scan2albedo.synthetic.sitter import BodyPart, head_around, sit_down

SMALL = Scanner(picture_size=400, size=128, spacing_mm=3.5)


@pytest.fixture(scope="module")
def sitter(model):
    return sit_down(0, expression="neutral", model=model)


@pytest.fixture(scope="module")
def made():
    return raw_scan(0, scanner=SMALL, material=Material(sigma_rad=0.0))


def test_pods_project_their_own_rays_back():
    target = np.array([1.0, 2.0, 3.0])
    pods = two_pods(target, reach_mm=200.0)
    for pod, place in zip(pods, camera_centers(pods), strict=True):
        shown = np.random.default_rng(0).uniform(0, 1, (20, 2))
        assert_allclose(project(pod, place + 800 * pixel_directions(pod, shown))[0], shown)
        assert_allclose(project(pod, target[None])[0], 0.5)
        assert project(pod, np.array([[1.0, 50.0, 3.0]]))[0][0, 1] > 0.5
        # The picture spans 200 mm to either side.
        edge = target + 200 * normalized(np.cross([0, 1, 0], place - target))
        assert_allclose(np.abs(project(pod, edge[None])[0][0, 0] - 0.5), 0.5)


def test_the_head_continues_the_face_without_a_crack(sitter):
    face = sitter.face
    loop = boundary_loop(len(face.vertices), face.faces)
    border = boundary_vertex_mask(len(face.vertices), face.faces)
    assert_array_equal(np.sort(loop), np.flatnonzero(border))
    vertices, faces, uv = head_around(face.vertices, face.faces, face.normals)
    assert_allclose(vertices[: len(loop)], face.vertices[loop], atol=1e-9)
    assert len(uv) == len(vertices)
    first_ring = vertices[faces[faces.min(1) < len(loop)]]
    assert row_lengths(np.ptp(first_ring, axis=1)).max() < 12


def test_parts_are_coloured_apart(sitter):
    rng = np.random.default_rng(0)
    mean = []
    for part in BodyPart:
        faces = rng.choice(np.flatnonzero(sitter.part == part), 500)
        albedo = sitter.albedo_at(faces, np.full((500, 3), 1 / 3))
        assert albedo.min() > 0
        mean.append(albedo.mean(0))
    assert_allclose(mean[BodyPart.FACE], mean[BodyPart.HEAD], rtol=0.25)
    assert np.linalg.norm(mean[BodyPart.HAIR] - mean[BodyPart.FACE]) > 0.1


def test_the_true_pose_lays_the_scan_on_the_true_face(made):
    scan, truth = made
    points = transform_points(truth.model_from_scan, scan.vertices)
    distance = ClosestPointQuery(*truth.image.occluder_mesh()).query(points).distance
    near = distance < 1
    assert near.sum() > 2500
    assert distance[near].mean() == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.2)
    covered = cKDTree(points).query(truth.landmarks[17:])[0]
    assert np.quantile(covered, 0.9) < 4


def test_texture_is_the_true_albedo_under_the_true_light(made):
    scan, truth = made
    points = transform_points(truth.model_from_scan, scan.vertices[scan.faces].mean(1))
    pixel = sample(scan, scan.uv.mean(1))
    mask = truth.image.mask
    distance, texel = cKDTree(truth.image.position[mask]).query(points)
    toward, _, irradiance = incident_light(points, truth.lights[0])
    cosine = np.einsum("ij,ij->i", truth.image.normal[mask][texel], toward)
    # Well-lit, unhidden places only: the front of the nearer cheek, forehead and chin.
    usable = (distance < 1.2) & (cosine > 0.6)
    shading = 1 + irradiance * cosine
    predicted = truth.exposure * truth.albedo_linear[mask][texel] * shading[:, None]
    typical = np.median(np.abs(pixel - predicted)[usable] / predicted[usable])
    assert usable.sum() > 1000
    assert typical < 0.06


def test_same_seed_same_scan(made):
    scan, truth = made
    again, same = raw_scan(0, scanner=SMALL, material=Material(sigma_rad=0.0))
    assert_array_equal(scan.vertices, again.vertices)
    assert_array_equal(scan.texture_linear, again.texture_linear)
    assert_array_equal(truth.albedo_linear, same.albedo_linear)


def test_it_is_raw(made):
    scan, truth = made
    assert len(np.unique(vertex_components(len(scan.vertices), scan.faces))) >= 3
    assert boundary_vertex_mask(len(scan.vertices), scan.faces).sum() > 200
    assert np.abs(truth.model_from_scan[:3, :3] - np.eye(3)).max() > 0.1
    assert scan.texture_linear.shape == (400, 800, 3)
    assert len(np.unique(scan.texture_linear)) <= 256
    assert scan.uv.min() >= 0
    assert scan.uv.max() <= 1
    extent = np.ptp(transform_points(truth.model_from_scan, scan.vertices), axis=0)
    assert 200 < extent[0] < 450
    assert 250 < extent[1] < 450


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_full_size_scans_have_20_to_40_thousand_vertices(seed):
    scan, truth = raw_scan(seed, expression="smile")
    assert 20_000 < len(scan.vertices) < 40_000
    assert truth.albedo_linear.shape == (512, 512, 3)
    assert np.bincount(vertex_components(len(scan.vertices), scan.faces)).max() > 0.9 * len(scan.vertices)
    assert len(truth.lights) == (2 if seed % 2 else 1)


@pytest.mark.slow
def test_light_of_several_colors_adds_up(sitter):
    lights = light_at(30), light_at(-40)
    pods = two_pods(sitter.face.vertices.mean(0), reach_mm=150.0)

    def pictured(colors):
        rng = np.random.default_rng(0)
        finish = Material(0.3, 0.1, 14.0)
        return flash_pictures(sitter, pods, lights, finish, size=32, noise=0, rng=rng, colors=colors)

    (plain, exposure), (white, same) = pictured(None), pictured(np.ones((3, 3)))
    assert same == pytest.approx(exposure, rel=1e-6)
    assert_allclose(white, plain, atol=0.02)  # a step of 8 bits
    _, brighter = pictured(np.full((3, 3), 0.5))
    assert brighter == pytest.approx(2 * exposure, rel=1e-6)
    red, _ = pictured(np.array([[1.0, 1, 1], [3.0, 1, 1], [1, 1, 1]]))
    lit = (plain.min(-1) > 0.05) & (red.min(-1) > 0.02)
    ratio = np.log(red[lit][:, 0] / red[lit][:, 1]) - np.log(plain[lit][:, 0] / plain[lit][:, 1])
    assert ratio.max() > 0.5  # in the red lamp's light
    assert np.percentile(ratio, 5) < 0.15  # in its shadow
