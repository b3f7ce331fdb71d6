"""Lines that misplaced outlines of shadows leave in an unlit texture."""

import numpy as np

from scan2albedo.applications.light_removal import outlines, without_lines

SIZE = 96
TEXELS_PER_MM = 2.0
STEP = np.log(4.0)


def strip(spacing_mm: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat grid of 40 mm, vertices (V, 3) and faces (F, 3)."""
    count = int(40 / spacing_mm) + 1
    x, y = np.meshgrid(np.arange(count) * spacing_mm, np.arange(count) * spacing_mm)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + count], 1),
            np.stack([corner + 1, corner + count + 1, corner + count], 1),
        ]
    )
    return vertices, faces


def test_outlines_lie_where_light_changes_fast():
    vertices, faces = strip()
    light = np.where(vertices[:, :1] < 20, STEP, 0.0) * np.ones(3)
    found = outlines(vertices, faces, light, np.array([[19.0, 10, 0], [14.9, 10, 0], [30, 10, 0]]))
    assert found[0, 0] == 1
    assert 0 < found[1, 0] < 1
    assert found[2, 0] == 0
    np.testing.assert_allclose(found[0, 1], STEP)


def test_a_light_that_changes_slowly_has_no_outline():
    vertices, faces = strip()
    assert not outlines(vertices, faces, 0.05 * vertices[:, :1] * np.ones(3), vertices).any()


def scene(contrast: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An albedo of two materials side by side, a line of 1.5 mm on their border, and outlines there."""
    rng = np.random.default_rng(0)
    column = np.arange(SIZE) - SIZE / 2
    true = np.where(column < 0, 0.4, 0.4 * contrast)[None, :, None] * np.ones((SIZE, SIZE, 3))
    true *= np.exp(0.02 * rng.standard_normal((SIZE, SIZE, 1)))
    wrong = true * np.where(np.abs(column) < 1.5, 3.0, 1.0)[None, :, None]
    near = np.clip((6 - np.abs(column) / TEXELS_PER_MM) / 3, 0, 1)
    found = np.stack([near, np.full(SIZE, STEP)], axis=1)[None] * np.ones((SIZE, 1, 1))
    return true, wrong, found


def test_a_bright_line_goes_and_detail_stays():
    true, wrong, found = scene(1.0)
    mended = without_lines(wrong, found, np.ones((SIZE, SIZE), bool), TEXELS_PER_MM)
    middle = np.s_[:, SIZE // 2 - 12 : SIZE // 2 + 12]
    assert np.abs(np.log(wrong / true))[middle].max() > 1
    assert np.abs(np.log(mended / true))[middle].max() < 0.15
    beside = np.s_[:, SIZE // 2 + 5 : SIZE // 2 + 12]
    pores, kept = np.log(true[beside][..., 0]).ravel(), np.log(mended[beside][..., 0]).ravel()
    assert np.corrcoef(pores, kept)[0, 1] > 0.9


def test_where_two_materials_meet_nothing_changes():
    _, wrong, found = scene(0.2)
    mended = without_lines(wrong, found, np.ones((SIZE, SIZE), bool), TEXELS_PER_MM)
    np.testing.assert_allclose(
        mended[:, SIZE // 2 - 4 : SIZE // 2 + 4], wrong[:, SIZE // 2 - 4 : SIZE // 2 + 4], rtol=1e-4
    )


def test_no_colour_changes_by_more_than_the_light():
    _, wrong, found = scene(1.0)
    found[..., 1] = 0.2
    mended = without_lines(wrong, found, np.ones((SIZE, SIZE), bool), TEXELS_PER_MM)
    # What is finer than the mean is limited apart.
    smooth = np.abs(np.log(mended / wrong))[:, : SIZE // 2 - 8]
    assert smooth.max() < 0.2 + 0.05


def test_without_outlines_the_texture_is_as_it_was():
    _, wrong, found = scene(1.0)
    same = without_lines(wrong, 0 * found, np.ones((SIZE, SIZE), bool), TEXELS_PER_MM)
    np.testing.assert_array_equal(same, wrong.astype(np.float32))
