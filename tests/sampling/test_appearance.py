"""What is skin: painted caps of an ellipsoid, in light of one and of several colours."""

import numpy as np
import pytest

from scan2albedo.sampling.appearance import appearance

SIZE, SIDE_MM = 120, 168.0
PALE, BROWN, DARK = (0.55, 0.33, 0.24), (0.25, 0.13, 0.08), (0.09, 0.045, 0.03)
WHITE_LAMP = (((0.4, 0.3, 0.86), (1.0, 1.0, 1.0)),)
WARM_AND_COLD = (((0.8, 0.1, 0.6), (1.0, 0.75, 0.5)), ((-0.7, 0.5, 0.5), (0.5, 0.65, 1.0)))


class Face:
    """A cap as wide as a face; `paint` changes its albedo, `texture` lights it."""

    def __init__(self, color=PALE, size=SIZE):
        x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
        self.x, self.y = x * SIDE_MM / 2, y * SIDE_MM / 2
        radius = np.hypot(x, y)
        self.mask = radius < 0.97
        z = np.sqrt(np.maximum(1.2 - radius**2, 0.1))
        self.position = np.stack([self.x, self.y, z * SIDE_MM / 2], -1)
        normal = np.stack([x, y, z], -1)
        self.normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self.random = np.random.default_rng(0)
        grain = 1 + 0.01 * self.random.standard_normal((size, size, 1))
        self.albedo = np.array(color) * grain

    def paint(self, where, color):
        self.albedo = np.where(where[..., None], np.asarray(color) * np.ones_like(self.albedo), self.albedo)
        return self

    def texture(self, lamps=WHITE_LAMP, ambient=(0.25, 0.25, 0.25), shadow=None):
        light = np.zeros_like(self.albedo)
        for direction, color in lamps:
            cosine = np.maximum(self.normal @ np.array(direction), 0)
            light += np.where(shadow is None or ~shadow, cosine, 0)[..., None] * np.array(color)
        return (self.albedo * (light + np.array(ambient))).astype(np.float32)

    def skin(self, texture, **sources):
        return appearance(self.position, self.normal, self.mask, texture, **sources).skin

    def stubble(self, where, contrast=0.25):
        factor = np.exp(contrast * self.random.standard_normal(where.shape))
        self.albedo = np.where(where[..., None], 0.7 * factor[..., None] * self.albedo, self.albedo)
        return self


@pytest.mark.parametrize("color", [PALE, BROWN, DARK], ids=["pale", "brown", "dark"])
@pytest.mark.parametrize("lamps", [WHITE_LAMP, WARM_AND_COLD], ids=["white", "warm and cold"])
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
    skin = face.skin(face.texture(shadow=shadow, ambient=(0.12, 0.15, 0.22)))
    assert skin[face.mask & shadow].mean() > 0.95
    assert skin[face.mask].min() > 0.3  # its outline, too


def test_moles_freckles_and_blush_stay_skin():
    face = Face()
    blush = np.exp(-((face.x - 35) ** 2 + (face.y + 5) ** 2) / 400)
    face.albedo *= 1 - blush[..., None] * np.array([0.0, 0.15, 0.1])
    freckles = (face.random.uniform(size=face.mask.shape) < 0.08) & (face.y > -10) & (face.y < 20)
    face.albedo *= np.where(freckles[..., None], [0.93, 0.86, 0.82], 1.0)
    moles = np.zeros_like(face.mask)
    for x, y in ((-40, 20), (10, -50), (30, 40)):
        moles |= np.hypot(face.x - x, face.y - y) < 3
    skin = face.paint(moles, (0.2, 0.1, 0.07)).skin(face.texture())
    assert skin[moles].mean() > 0.9
    assert skin[face.mask].mean() > 0.95


@pytest.mark.parametrize("lamps", [WHITE_LAMP, WARM_AND_COLD], ids=["white", "warm and cold"])
def test_hair_and_stubble_are_not_skin(lamps):
    face = Face()
    fringe, beard = face.y > 45, face.y < -35
    strands = fringe & (np.sin(face.x * 1.7 + 3 * np.sin(face.y / 9)) > 0)
    face.paint(fringe, (0.2, 0.14, 0.08)).paint(strands, (0.08, 0.055, 0.03)).stubble(beard)
    skin = face.skin(face.texture(lamps))
    for name, other in (("fringe", fringe), ("beard", beard)):
        assert skin[face.mask & other].mean() < 0.2, name
    assert skin[face.mask & ~fringe & ~beard].mean() > 0.85


@pytest.mark.parametrize("cloth", [(0.1, 0.2, 0.5), (0.02, 0.02, 0.02), (0.5, 0.5, 0.52)])
def test_cloth_over_half_the_face_is_not_taken_for_it(cloth):
    face = Face()
    covered = face.y < 5
    skin = face.paint(covered, cloth).skin(face.texture())
    assert skin[face.mask & (face.y < -2)].mean() < 0.2
    assert skin[face.mask & (face.y > 12)].mean() > 0.9


def test_a_cap_and_eyes_are_not_skin_without_a_region():
    face = Face(BROWN)
    cap, eye = face.y > 40, np.hypot(face.x - 30, (face.y - 15) * 2) < 15
    skin = face.paint(cap, (0.4, 0.05, 0.06)).paint(eye, (0.5, 0.5, 0.5)).skin(face.texture())
    assert skin[face.mask & (face.y > 45)].mean() < 0.1
    assert skin[np.hypot(face.x - 30, (face.y - 15) * 2) < 12].mean() < 0.2
    assert skin[face.mask & (face.y < -5)].mean() > 0.95


def test_brows_of_the_same_hue_are_found_where_brows_are_annotated():
    face = Face()
    brow = (np.abs(face.y - 30) < 5) & (np.abs(face.x) > 12) & (np.abs(face.x) < 50)
    region = (np.abs(face.y - 28) < 10) & (np.abs(face.x) < 55)
    face.stubble(brow, 0.5)
    face.albedo = np.where(brow[..., None], 0.6 * face.albedo, face.albedo)
    skin = face.skin(face.texture(), share=np.where(region, 0.8, 1.0))
    assert skin[brow].mean() < 0.45
    assert skin[face.mask & ~region].mean() > 0.97


def test_grey_textures_have_their_grain_alone():
    face = Face((0.3, 0.3, 0.3))
    beard = face.y < -35
    skin = face.skin(face.stubble(beard).texture())
    assert skin[face.mask & beard].mean() < 0.2
    assert skin[face.mask & (face.y > -25)].mean() > 0.97


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
    assert skin[kept & (face.y > 50)] == pytest.approx(0.3 / 0.95, abs=0.01)


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
    across, down = np.gradient(nose, face.x[0], axis=1), np.gradient(nose, face.y[:, 0], axis=0)
    normal = face.normal - np.stack([across, down, 0 * nose], -1)
    face.normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    skin = face.skin(face.texture())
    assert skin[face.mask].mean() > 0.95


def test_finer_images_say_the_same():
    means = []
    for size in (SIZE, 3 * SIZE):
        face = Face(size=size)
        face.albedo = np.array(PALE) * np.ones_like(face.albedo)
        fringe = face.y > 45
        strands = fringe & (np.sin(face.x * 1.7 + 3 * np.sin(face.y / 9)) > 0)
        face.paint(fringe, (0.2, 0.14, 0.08)).paint(strands, (0.08, 0.055, 0.03))
        skin = face.skin(face.texture())
        means.append([skin[face.mask & fringe].mean(), skin[face.mask & ~fringe].mean()])
    assert means[0] == pytest.approx(means[1], abs=0.1)


def hair_everywhere(face):
    return face.stubble(face.mask, 0.5).texture()


@pytest.mark.parametrize(
    ("texture", "least", "most"),
    [
        (hair_everywhere, 0.0, 0.25),
        (lambda face: face.paint(face.mask, (0.1, 0.2, 0.6)).texture(), 0.9, 1.0),
        (lambda face: np.full((SIZE, SIZE, 3), 0.4, np.float32), 0.99, 1.0),
        (lambda face: np.zeros((SIZE, SIZE, 3), np.float32), 0.99, 1.0),
        (lambda face: np.full((SIZE, SIZE, 3), 1e6, np.float32), 0.99, 1.0),
    ],
    ids=["all hair", "no skin: one blue plastic", "one colour", "black", "brighter than white"],
)
def test_surfaces_without_a_contrast_to_skin(texture, least, most):
    face = Face()
    skin = face.skin(texture(face))[face.mask]
    assert np.isfinite(skin).all()
    assert least <= skin.mean() <= most


@pytest.mark.parametrize("texels", [0, 2])
def test_a_mask_of_hardly_a_texel(texels):
    face = Face()
    face.mask[:] = False
    face.mask[SIZE // 2, SIZE // 2 : SIZE // 2 + texels] = True
    skin = face.skin(face.texture())
    assert skin[face.mask] == pytest.approx(1)
    assert skin.sum() == pytest.approx(texels)


def test_an_image_of_eight_texels():
    face = Face(size=8)
    assert np.isfinite(face.skin(face.texture())).all()
