import numpy as np
import pytest
import trimesh
from helpers.chart_distortion import chart_distortion
from helpers.crossings import crossing_triangles
from helpers.measures import row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import adjacency, edges_with_faces, face_areas
from scan2albedo.geometry.parametrization import boundary_loop, signed_areas

ROWS = (
    range(17),
    range(17, 27),
    range(31, 36),
    (*range(36, 40), *range(42, 46)),
    (40, 41, 46, 47),
    range(48, 55),
    range(55, 60),
    range(60, 65),
    range(65, 68),
)
"""iBUG-68: rows of landmarks, each its own mirror image; all others lie on the midline."""


def mirror_of(points):
    """Return, for each point, the index of its mirror image at x = 0."""
    distance = row_lengths(points[None] * [-1, 1, 1] - points[:, None])
    assert distance.min(1).max() < 1e-9
    return np.argmin(distance, axis=1)


def test_size_and_topology(model):
    assert 500 <= len(model.control_vertices) <= 1000
    loop = boundary_loop(len(model.control_vertices), model.control_faces)
    assert 30 < len(loop) < 120
    assert edges_with_faces(model.control_faces)[1].max() == 2


def test_triangles_are_well_shaped(model):
    vertices, faces = model.surface(0)
    skin = faces[~model.in_region("between_lips")]
    corners = vertices[skin]
    sides = row_lengths(corners - np.roll(corners, 1, axis=1))
    quality = 4 * np.sqrt(3) * face_areas(vertices, skin) / np.sum(sides**2, axis=1)
    assert quality.min() > 0.35
    assert np.mean(quality) > 0.85
    valence = adjacency(len(vertices), faces).sum(1)
    assert 3 <= valence.min() < valence.max() <= 8


def test_mirror_symmetry_of_everything(model):
    mirror = mirror_of(model.control_vertices)
    assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    assert_allclose(model.uv[mirror], model.uv * [-1, 1] + [1, 0], atol=1e-12)
    region_of = dict(zip(map(frozenset, model.control_faces.tolist()), model.region, strict=True))
    other = {}
    for name, region in model.regions.items():
        twin = name.replace("left", "right") if "left" in name else name.replace("right", "left")
        other[region.index] = model.regions[twin].index
    for face, region in region_of.items():
        assert region_of[frozenset(mirror[list(face)])] == other[region]


def test_frame(model):
    surface, faces = model.surface(2)
    centroid = np.average(surface[faces].mean(1), axis=0, weights=face_areas(surface, faces))
    assert_allclose(centroid, 0, atol=1e-9)
    assert model.landmarks[42, 0] > 0 > model.landmarks[39, 0]  # the left eye lies at +x
    assert model.landmarks[27, 1] > model.landmarks[8, 1]
    assert np.argmax(model.landmarks[:, 2]) == 30


def test_landmarks_are_symmetric_and_ordered(model):
    points, expected = model.landmarks, np.arange(68)
    for row in ROWS:
        expected[list(row)] = row[::-1]
    assert_array_equal(mirror_of(points), expected)
    for row in (range(1, 16), *ROWS[1:4], range(48, 55), range(60, 65)):
        assert np.all(np.diff(points[list(row), 0]) > 0)
    assert np.all(np.diff(points[27:31, 1]) < 0)
    assert points[51, 1] > points[62, 1] > points[66, 1] > points[57, 1]


def test_measurements_between_landmarks(model):
    # Heights of face, nose, nose's tip, upper lip, upper face, lower face; widths of mouth and eyes; an eye.
    first = [27, 27, 33, 33, 27, 33, 48, 39, 36, 43]
    second = [8, 33, 30, 62, 62, 8, 54, 42, 45, 47]
    published_mm = [118, 53, 19.5, 21, 73, 68.5, 52, 32.5, 89.5, 11]
    distances = row_lengths(model.landmarks[first] - model.landmarks[second])
    assert distances == pytest.approx(published_mm, abs=2.1)


def test_published_widths_of_the_surface(model):
    surface, faces = model.surface(3)
    from_nasion = surface - model.landmarks[27]
    x, y, z = from_nasion[faces[model.in_region("nose")[model.subdivision(3).parent]]].reshape(-1, 3).T
    assert 2 * x[(abs(y + 45) < 2) & (z > 0)].max() == pytest.approx(33.0, abs=2)
    temple = [113.5 / 2, 25.0, -29.36]
    cheekbone = [134.5 / 2, -28.0, -55.26]
    jaw = [100.5 / 2, -93.5, -57.0]
    assert ClosestPointQuery(from_nasion, faces).query([temple, cheekbone, jaw]).distance.max() < 1
    hairline = from_nasion[np.abs(from_nasion[:, 0]) < 1e-9][:, 1:]
    assert np.linalg.norm(hairline[np.argmax(hairline[:, 0])]) == pytest.approx(65.0, abs=2)


def test_regions(model):
    names = {"forehead", "nose", "upper_lip", "lower_lip", "chin", "between_lips"}
    for pair in ("brow", "eye", "nostril", "cheek", "jaw", "temple"):
        names |= {f"left_{pair}", f"right_{pair}"}
    assert set(model.regions) == names
    assert all(model.in_region(name).sum() >= 2 for name in names)
    assert not any(model.regions[n].inpaint for n in names if n.endswith(("eye", "brow", "lip")))
    assert model.regions["nose"].stiffness > model.regions["chin"].stiffness
    assert model.regions["forehead"].stiffness > model.regions["upper_lip"].stiffness
    assert model.regions["nose"].specular_scale > model.regions["left_cheek"].specular_scale
    assert model.regions["left_cheek"].specular_scale > model.regions["left_brow"].specular_scale
    assert model.region_values("inpaint")[model.regions["upper_lip"].index] == 0


def test_landmarks_lie_in_their_regions(model):
    names = {region.index: name for name, region in model.regions.items()}
    for landmark, name in {
        19: "right_brow",
        24: "left_brow",
        30: "nose",
        62: "lip",
        51: "upper_lip",
        57: "lower_lip",
        8: "chin",
        12: "left_jaw",
        4: "right_jaw",
        43: "left_eye",
        46: "left_eye",
        37: "right_eye",
    }.items():
        assert name in names[model.region[model.landmark_points.face[landmark]]], landmark


def test_each_region_is_one_piece(model):
    for name in model.regions:
        part = trimesh.Trimesh(model.control_vertices, model.control_faces[model.in_region(name)])
        assert len(part.split(only_watertight=False)) == 1, name


def test_mouth_line_divides_the_lips(model):
    line = model.landmarks[[48, 60, 61, 62, 63, 64, 54]]
    for name, sign in (("upper_lip", 1), ("lower_lip", -1)):
        x, y, _ = model.surface(0)[0][np.unique(model.control_faces[model.in_region(name)])].T
        height = sign * (y - np.interp(x, line[:, 0], line[:, 1]))
        assert height[abs(x) < 15].min() > -0.4


def test_the_lips_part_along_a_film(model):
    lips = [set(model.control_faces[model.in_region(name)].ravel()) for name in ("upper_lip", "lower_lip")]
    vertices, _ = model.surface(0)
    half_width = model.landmarks[54, 0]
    assert all(abs(vertices[v, 0]) > 0.9 * half_width for v in lips[0] & lips[1])
    in_film = model.in_region("between_lips")
    film = model.control_faces[in_film]
    assert np.ptp(vertices[film, 1], axis=1).max() < 2.5
    assert np.ptp(vertices[film, 0]) == pytest.approx(2 * half_width, rel=0.1)
    assert set(film.ravel()) <= lips[0] | lips[1]
    assert not in_film[model.landmark_points.face].any()


def test_chart(model):
    quality = chart_distortion(*model.surface(0), model.uv)
    assert quality.flipped == 0
    assert quality.coverage >= 0.75
    assert quality.area < 0.3
    assert quality.conformal < 1.5
    for levels in range(4):
        subdivision = model.subdivision(levels)
        uv = subdivision.matrix @ model.uv
        assert signed_areas(uv, subdivision.faces).min() > 0
        assert 0 <= uv.min() < uv.max() <= 1
    for axis in (0, 1):
        assert np.corrcoef(model.uv[:, axis], model.control_vertices[:, axis])[0, 1] > 0.95


def test_surface_does_not_cut_itself(model):
    assert crossing_triangles(*model.surface(1)) == 0


def test_limit_surface_is_smooth(model):
    angle = np.degrees(trimesh.Trimesh(*model.surface(3), process=False).face_adjacency_angles)
    assert angle.max() < 45
    assert np.quantile(angle, 0.99) < 12
