"""Skinned meshes, written and read: judged by what stands in the file, read without our reader."""

import numpy as np
import pytest
from helpers.gltf import Gltf
from helpers.square import SQUARE_FACES, SQUARE_MM, square_gltf
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ScanError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, skin, solve_weights
from scan2albedo.eyeglasses.keypoints import PARENTS, SKELETON
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.rigid import compose, rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.io.glb import write_skinned_glb
from scan2albedo.synthetic import eyeglasses

AXES = np.tile(np.eye(4), (20, 1, 1))


class File(Gltf):
    """A GLB with a skeleton taken apart by the standard's text."""

    def places(self, moved=None):
        """World transforms of all nodes, with the transforms of some replaced."""
        world = {}

        def visit(number, above):
            node = self.tree["nodes"][number]
            local = (moved or {}).get(node["name"], compose(np.eye(3), node.get("translation", np.zeros(3))))
            world[number] = above @ local
            for child in node.get("children", []):
                assert child not in world
                visit(child, world[number])

        for root in self.tree["scenes"][self.tree["scene"]]["nodes"]:
            visit(root, np.eye(4))
        return world

    def joints(self, moved=None):
        """Joint transforms times inverse bind matrices (J, 4, 4)."""
        entry, world = self.tree["skins"][0], self.places(moved)
        inverse = self.array(entry["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        assert len(inverse) == len(entry["joints"])
        return np.array([world[joint] for joint in entry["joints"]]) @ inverse

    def skinned(self, moved=None):
        """Vertices in metres as a viewer shows them."""
        maps, position = self.joints(moved), self.array(self.attributes["POSITION"])
        points = np.column_stack([position, np.ones(len(position))])
        result = np.zeros_like(position, float)
        for n in range(sum(name.startswith("JOINTS") for name in self.attributes)):
            joints, weights = (self.array(self.attributes[f"{a}_{n}"]) for a in ("JOINTS", "WEIGHTS"))
            for k in range(4):
                result += weights[:, k, None] * np.einsum("vab,vb->va", maps[joints[:, k]], points)[:, :3]
        return result


@pytest.fixture(scope="module")
def weighted():
    glasses = eyeglasses(0)
    return glasses, solve_weights(glasses.vertices, glasses.faces, glasses.keypoints, 3.0).weights


@pytest.fixture
def written(weighted, tmp_path):
    """Write the glasses, or with changes, as a.glb; return the file and what the writer tells."""
    glasses, weights = weighted
    mesh = {"vertices": glasses.vertices, "faces": glasses.faces, "names": KEY_POINT_NAMES}
    mesh |= {"keypoints": glasses.keypoints, "weights": weights, "parents": PARENTS}

    def write(**changes):
        told = write_skinned_glb(tmp_path / "a.glb", **mesh | changes)
        return File.read(tmp_path / "a.glb"), told

    return write


def test_the_file_is_what_the_standard_asks_for(weighted, written, tmp_path):
    glasses, weights = weighted
    file, told = written()
    tree, attributes = file.tree, file.attributes
    kinds = {name: tree["accessors"][number] for name, number in attributes.items()}
    assert {n: (a["componentType"], a["type"]) for n, a in kinds.items()} == {
        "POSITION": (5126, "VEC3"),
        "NORMAL": (5126, "VEC3"),
        "JOINTS_0": (5121, "VEC4"),
        "WEIGHTS_0": (5126, "VEC4"),
    }
    position, normal, joints, shares = (file.array(attributes[name]) for name in kinds)
    assert_allclose(position, glasses.vertices * 1e-3, atol=1e-8)
    assert "min" in kinds["POSITION"]
    assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    assert_array_equal(file.array(file.primitive["indices"]).reshape(-1, 3), glasses.faces)
    assert np.abs(shares.sum(1, dtype=np.float64) - 1).max() < 2e-7 * 4
    assert shares.min() >= 0
    assert (np.diff(shares, axis=1) <= 0).all()
    assert (joints[shares == 0] == 0).all()
    assert tree["nodes"][0] == {"name": "frame", "mesh": 0, "skin": 0}
    (skeleton,) = tree["skins"]
    assert {0, skeleton["skeleton"]} == set(tree["scenes"][0]["nodes"])
    assert [tree["nodes"][j]["name"] for j in skeleton["joints"]] == list(KEY_POINT_NAMES)
    # At rest every joint stands at its key point and moves nothing.
    assert_allclose(file.joints(), AXES, atol=1e-7)
    places = [file.places()[j][:3, 3] for j in skeleton["joints"]]
    assert_allclose(places, glasses.keypoints * 1e-3, atol=1e-12)
    assert told[0].shape == weights.shape
    scan = load_scan(tmp_path / "a.glb")
    assert_allclose(scan.vertices, glasses.vertices, atol=1e-4)
    assert_array_equal(scan.faces, glasses.faces)


def test_bones_of_the_file_are_bones_of_the_glasses(written):
    file, _ = written()
    at, nodes = {name: k for k, name in enumerate(KEY_POINT_NAMES)}, file.tree["nodes"]
    bones = [{at[node["name"]], at[nodes[c]["name"]]} for node in nodes[2:] for c in node.get("children", [])]
    assert len(bones) == 19
    assert all(bone in [set(of_glasses) for of_glasses in SKELETON] for bone in bones)


def test_moving_joints_in_the_file_moves_vertices_as_skinning_does(weighted, written):
    glasses = weighted[0]
    rng = np.random.default_rng(0)
    file, (shares, _) = written()
    moved = {
        name: compose(rotation_from_vector(rng.normal(0, 0.1, 3)), rng.normal(0, 1e-2, 3))
        for name in ("bridge_top", "left_hinge", "right_ear_bend")
    }
    maps_mm = file.joints(moved)
    maps_mm[:, :3, 3] *= 1e3
    expected = skin(glasses.vertices, shares, maps_mm)
    assert_allclose(1e3 * file.skinned(moved), expected, atol=2e-4)
    assert np.abs(expected - glasses.vertices).max() > 5


def test_the_cut_bounds_what_it_moves(weighted, written):
    glasses, weights = weighted
    _, (shares, cut) = written()
    assert cut == pytest.approx((1 - np.sort(weights, axis=1)[:, -4:].sum(1)).max(), abs=1e-6)
    assert 1e-4 < cut < 0.2
    assert ((shares > 0).sum(1) <= 4).all()
    shifts = AXES.copy()
    shifts[:, :3, 3] = np.random.default_rng(0).normal(0, 3, (20, 3))
    apart = np.linalg.norm(shifts[:, None, :3, 3] - shifts[None, :, :3, 3], axis=-1).max()
    difference = skin(glasses.vertices, shares, shifts) - skin(glasses.vertices, weights, shifts)
    assert np.linalg.norm(difference, axis=1).max() <= cut * apart + 1e-6


def test_missing_key_points_get_no_node_and_others_hang_higher(weighted, written):
    glasses = weighted[0]
    points = glasses.keypoints.copy()
    gone = [KEY_POINT_NAMES.index(name) for name in ("bridge_top", "left_hinge", "left_rim_top")]
    points[gone] = np.nan
    kept = np.setdiff1d(np.arange(20), gone)
    weights = np.zeros_like(weighted[1])
    weights[:, kept] = solve_weights(glasses.vertices, glasses.faces, points[kept], 3.0).weights
    file, told = written(weights=weights, keypoints=points)
    nodes = file.tree["nodes"]
    assert {node["name"] for node in nodes[2:]} == {KEY_POINT_NAMES[k] for k in kept}
    named = {node["name"]: node for node in nodes}
    hanging = {nodes[c]["name"] for c in named["left_rim_bridge"]["children"]}
    assert hanging == {"left_rim_inner", "left_temple_middle", "left_rim_outer"}
    assert len(named["skeleton"]["children"]) == 3
    assert_allclose(file.joints(), AXES[:17], atol=1e-7)
    assert_allclose(1e3 * file.skinned(), glasses.vertices, atol=1e-4)
    assert (told[0][:, gone] == 0).all()


def skinned_square(*, mesh_node=None, joint_node=None, inverse=AXES[:2], joints=(0, 0, 0, 0)):
    """The square on two joints, of which each corner has one of `joints`."""
    file, chosen = square_gltf(), np.zeros((4, 4), "<u1")
    chosen[:, 0] = joints
    file.attributes["JOINTS_0"] = file.add(chosen)
    file.attributes["WEIGHTS_0"] = file.add(np.eye(4, dtype="<f4")[[0] * 4])
    bound = file.add(inverse.transpose(0, 2, 1).astype("<f4"))
    file.tree["skins"] = [{"joints": [2, 1], "inverseBindMatrices": bound}]
    file.tree["nodes"] = [{"mesh": 0, "skin": 0, **(mesh_node or {})}, {}, joint_node or {}]
    file.tree["scenes"][0]["nodes"] = [0, 1, 2]
    return file


def test_the_transform_of_a_skinned_meshs_own_node_counts_for_parts_without_joints_alone(tmp_path):
    file = skinned_square(mesh_node={"translation": [5, 6, 7]})
    assert_allclose(file.load(tmp_path, "mm").vertices, SQUARE_MM, atol=1e-5)
    plain = {name: file.attributes[name] for name in ("POSITION", "TEXCOORD_0")}
    file.tree["meshes"][0]["primitives"].append({**file.primitive, "attributes": plain})
    expected = np.concatenate([SQUARE_MM, SQUARE_MM + [5, 6, 7]])
    assert_allclose(file.load(tmp_path, "mm").vertices, expected, atol=1e-5)


def test_joints_carry_their_vertices(tmp_path):
    turned = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "translation": [10, 0, 0]}
    bound = AXES[:2] @ compose(np.eye(3), [-1, -2, -3])
    file = skinned_square(joint_node=turned, inverse=bound, joints=(0, 1, 1, 0))
    expected = SQUARE_MM - [1, 2, 3]
    expected[[0, 3]] = np.stack([-expected[:, 1] + 10, expected[:, 0], expected[:, 2]], 1)[[0, 3]]
    assert_allclose(file.load(tmp_path, "mm").vertices, expected, atol=1e-4)


def test_a_mirroring_joint_keeps_faces_outward_and_one_that_is_not_there_is_refused(tmp_path):
    scan = skinned_square(joint_node={"scale": [-1, 1, 1]}).load(tmp_path, "mm")
    assert (face_normals(scan.vertices, scan.faces)[:, 2] > 0).all()
    with pytest.raises(ScanError, match=r"a\.glb"):
        skinned_square(joints=(7, 0, 0, 0)).load(tmp_path, "mm")


ONE_JOINT = {
    "vertices": SQUARE_MM,
    "faces": SQUARE_FACES,
    "keypoints": np.zeros((1, 3)),
    "weights": np.ones((4, 1)),
    "names": ["a"],
    "parents": [-1],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.ones((4, 2))}, r"weights is \(4, 2\), expected \(4, 1\)"),
        ({"weights": np.full((4, 1), 0.5)}, "sum to 1"),
        ({"keypoints": [[np.nan] * 3]}, "0 for missing"),
        ({"parents": [0]}, "circle"),
        ({"faces": SQUARE_FACES + 1}, "faces refer to vertices 1 to 4 of 4"),
        ({"vertices": SQUARE_MM * np.nan}, "4 of 4 vertices are NaN"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        write_skinned_glb(tmp_path / "a.glb", **ONE_JOINT | change)
    assert list(tmp_path.iterdir()) == []
