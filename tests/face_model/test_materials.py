"""What is skin: synthetic people with caps and beards, painted ellipsoids, light of several colours."""

import numpy as np
import pytest

from scan2albedo.face_model.materials import CLASSES, chart_materials
from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic import face, light_at

SIZE = 120
SIDE_MM = 168.0
PALE = (0.55, 0.33, 0.24)
BROWN = (0.25, 0.13, 0.08)
DARK = (0.09, 0.045, 0.03)
WHITE_LAMP = (((0.4, 0.3, 0.86), (1.0, 1.0, 1.0)),)
WARM_AND_COLD = (((0.8, 0.1, 0.6), (1.0, 0.75, 0.5)), ((-0.7, 0.5, 0.5), (0.5, 0.65, 1.0)))


class Face:
    """A cap as wide as a face; `paint` changes its albedo, `texture` lights it."""

    def __init__(self, color=PALE, size=SIZE):
        x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
        self.mask = np.hypot(x, y) < 0.97
        cap = np.stack([x, y, np.sqrt(np.maximum(1.2 - x**2 - y**2, 0.1))], -1)
        self.position, self.normal = cap * SIDE_MM / 2, normalized(cap)
        self.x, self.y, _ = np.moveaxis(self.position, -1, 0)
        self.random = np.random.default_rng(0)
        self.albedo = color * (1 + 0.01 * self.random.standard_normal((size, size, 1)))

    def paint(self, where, color):
        self.albedo = np.where(where[..., None], color, self.albedo)
        return self

    def texture(self, lamps=WHITE_LAMP, ambient=0.25, lit=1.0):
        """The albedo in ambient light and that of lamps, the part of which `lit` (H, W) arrives."""
        light = np.zeros_like(self.albedo) + ambient
        for direction, color in lamps:
            light += (lit * np.maximum(self.normal @ direction, 0))[..., None] * color
        return (self.albedo * light).astype(np.float32)

    def skin(self, texture, **sources):
        return chart_materials(self.position, self.normal, self.mask, texture, **sources).skin


class Person:
    """A synthetic person whose albedo can be painted over."""

    def __init__(self, seed, size=128):
        made = face(seed, size=size, bits=None, lights=[light_at(30, 15)])
        self.image, self.albedo = made.image, made.albedo_linear.astype(np.float64)
        self.light = made.image.texture_linear / np.maximum(self.albedo, 1e-6)
        self.row, self.column = (np.indices(self.image.shape) + 0.5) / size
        self.random = np.random.default_rng(seed)
        cheeks = self.image.mask & (self.row > 0.45) & (self.row < 0.6)
        self.cheeks = cheeks & (np.abs(self.column - 0.5) > 0.2)

    def found(self, **changes):
        """Return what is told of the person with another `albedo`, or in another `light`."""
        image, place = self.image, np.stack([self.row, self.column], -1)
        parts = {"albedo": self.albedo, "light": self.light} | changes
        texture = (parts["albedo"] * parts["light"]).astype(np.float32)
        return chart_materials(image.position, image.normal, image.seen, texture, place=place)

    def share(self, labels, name, where):
        return np.mean(labels[where & self.image.mask] == CLASSES.index(name))


@pytest.fixture(scope="module", params=range(3))
def person(request):
    return Person(request.param)


def test_a_person_has_skin_lips_and_brows_where_they_are(person):
    found, plain = person.found(), person.image.mask
    assert found.skin[person.cheeks].mean() > 0.9
    assert 0.005 < person.share(found.labels, "lip", plain) < 0.06
    assert 0.005 < person.share(found.labels, "eye", plain) < 0.08
    assert not found.labels[~plain].any()
    assert found.log_odds > 0


def test_the_strength_of_the_light_changes_nothing(person):
    one, other = person.found(), person.found(light=0.1 * person.light)
    np.testing.assert_allclose(one.skin, other.skin, atol=0.02)
    assert one.log_odds == pytest.approx(other.log_odds, abs=0.05)


@pytest.mark.parametrize(
    ("tone", "cloth"),
    [
        ((0.45, 0.3, 0.2), (0.7, 0.7, 0.72)),  # white on brown
        ((0.45, 0.3, 0.2), 3 * [0.02]),
        (1, 3 * [0.02]),  # black on pale
        (1, (0.05, 0.1, 0.4)),
    ],
)
def test_a_cap_is_cloth_and_the_face_below_stays_skin(person, tone, cloth):
    cap = person.row < 0.2
    weave = np.exp(0.03 * person.random.standard_normal(cap.shape))[..., None]
    found = person.found(albedo=np.where(cap[..., None], cloth * weave, person.albedo * tone))
    assert found.skin[person.image.mask & (person.row < 0.18)].mean() < 0.2
    assert found.skin[person.cheeks].mean() > 0.85


def test_a_dense_beard_is_not_skin(person):
    jaw = (person.row > 0.78) & person.image.mask
    strands = np.exp(-0.9 * np.clip(0.8 + person.random.standard_normal(jaw.shape), 0, 2))
    bearded = person.albedo * np.where(jaw, strands, 1)[..., None]
    assert person.found(albedo=bearded).skin[jaw & (person.row > 0.82)].mean() < 0.3


def test_a_deep_shadow_over_the_cheek_stays_skin(person):
    shade = (person.column > 0.62) & (person.row > 0.42)
    found = person.found(light=person.light * np.where(shade, 0.12, 1)[..., None])
    cheek = person.image.mask & (person.column > 0.7) & (person.row > 0.5) & (person.row < 0.62)
    assert found.skin[cheek].mean() > 0.8
    assert person.share(found.labels, "cloth", shade) < 0.1


def test_a_texture_of_another_shape_speaks_against_it(person):
    turned = person.found(albedo=person.albedo[::-1], light=person.light[::-1])
    assert turned.log_odds < person.found().log_odds - 1


@pytest.mark.parametrize("color", [PALE, BROWN, DARK])
@pytest.mark.parametrize("lamps", [WHITE_LAMP, WARM_AND_COLD])
def test_bare_skin_stays_skin(color, lamps):
    face = Face(color)
    skin = face.skin(face.texture(lamps))
    assert skin[face.mask].mean() > 0.98
    assert np.percentile(skin[face.mask], 2) > 0.8
    assert skin.dtype == np.float32
    assert not skin[~face.mask].any()


def test_a_shadow_that_another_light_fills_stays_skin():
    face = Face()
    shadow = (face.x > 5) & (face.y < 40)
    skin = face.skin(face.texture(lit=~shadow, ambient=(0.12, 0.15, 0.22)))
    assert skin[face.mask & shadow].mean() > 0.95
    assert np.percentile(skin[face.mask], 1) > 0.3  # its outline, too


def test_a_cap_and_eyes_are_not_skin_without_a_region():
    face = Face(BROWN)
    cap, eye = face.y > 40, np.hypot(face.x - 30, (face.y - 15) * 2) < 15
    skin = face.paint(cap, (0.4, 0.05, 0.06)).paint(eye, (0.5, 0.5, 0.5)).skin(face.texture())
    assert skin[face.mask & (face.y > 45)].mean() < 0.1
    assert skin[np.hypot(face.x - 30, (face.y - 15) * 2) < 12].mean() < 0.2
    assert skin[face.mask & (face.y < -5)].mean() > 0.95


def test_without_texture_region_and_residual_decide():
    face = Face()
    region = face.y > 40
    residual = np.where(face.x > 20, 5.0, 0.2)
    residual[face.x < -60] = np.nan
    skin = face.skin(None, share=np.where(region, 0.3, 1.0), residual_mm=residual)
    assert skin[face.mask & (face.x > 20)].max() == 0
    assert skin[face.mask & (face.x < -60)].max() == 0
    kept = face.mask & (face.x < 15) & (face.x > -55)
    assert skin[kept & (face.y < 30)] == pytest.approx(1)
    assert skin[kept & (face.y > 50)].max() < 0.6


def test_rough_relief_is_hair():
    face = Face()
    beard = face.y < -35
    residual = np.abs(face.random.normal(0, np.where(beard, 0.5, 0.1)))
    skin = face.skin(None, residual_mm=residual)
    assert skin[face.mask & (face.y < -42)].mean() < 0.3
    assert skin[face.mask & (face.y > -25)].mean() > 0.97
    assert face.skin(None, residual_mm=0.1 * residual)[face.mask].mean() > 0.97  # less than any scan's noise


def test_coarse_images_keep_the_relief_of_a_face():
    face = Face(size=40)
    nose = 20 * np.exp(-((face.x / 10) ** 2 + (face.y / 20) ** 2))
    down, across = np.gradient(nose, face.y[:, 0], face.x[0])
    face.normal = normalized(face.normal - np.stack([across, down, 0 * nose], -1))
    skin = face.skin(face.texture())
    assert skin[face.mask].mean() > 0.95


def test_finer_images_say_the_same():
    means = []
    for size in (SIZE, 3 * SIZE):
        face = Face(size=size)
        fringe = face.y > 45
        strands = fringe & (np.sin(face.x * 1.7 + 3 * np.sin(face.y / 9)) > 0)
        face.paint(~fringe, PALE).paint(fringe, (0.2, 0.14, 0.08)).paint(strands, (0.08, 0.055, 0.03))
        skin = face.skin(face.texture())
        means.append([skin[face.mask & fringe].mean(), skin[face.mask & ~fringe].mean()])
    assert means[0] == pytest.approx(means[1], abs=0.1)


def test_surfaces_without_a_contrast_count_as_skin():
    face, even = Face(), np.ones((SIZE, SIZE, 3), np.float32)
    blue_plastic = face.paint(face.mask, (0.1, 0.2, 0.6)).texture()
    for texture, least in ((blue_plastic, 0.9), (0.4 * even, 0.99), (0 * even, 0.99), (1e6 * even, 0.99)):
        assert least <= face.skin(texture)[face.mask].mean() <= 1


@pytest.mark.parametrize("texels", [0, 2])
def test_a_mask_of_hardly_a_texel(texels):
    face = Face()
    face.mask[:] = False
    face.mask[60, 60 : 60 + texels] = True
    assert face.skin(face.texture()) == pytest.approx(1.0 * face.mask)


def test_an_image_of_eight_texels():
    face = Face(size=8)
    assert np.isfinite(face.skin(face.texture())).all()
