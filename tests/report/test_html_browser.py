"""The page in a headless Chromium: the picture is the library's, and everything on it works."""

import base64
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from devtools import Browser, chromium
from PIL import Image

import scan2albedo as s2a
from scan2albedo import report
from scan2albedo.applications import FaceMesh, RelightOptions, default_camera, load_result, relight
from scan2albedo.core import EnvironmentLight
from scan2albedo.io.geometry_image_files import read_image_and_albedo, write_geometry_image
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import write_exr
from scan2albedo.synthetic import light_at

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="there is no Chromium: apt-get install chromium"),
]
SIZE = 256
FIRST = "[...scan2albedo.viewers.values()][0]"
PRESETS = "[...document.querySelectorAll('.presets button')]"
FRONT = {"azimuth": 0, "elevation": 0, "zoom": 1}
EVIL = "<img src=x onerror=document.title='broken'>"


@pytest.fixture(scope="module")
def browser():
    with Browser() as opened:
        yield opened
        assert opened.messages == []
        own = ("file:", "about:", "data:")
        assert [url for url in opened.requests if not url.startswith(own)] == []


@pytest.fixture(scope="module")
def face_folder(write_scan, tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("browser") / "face", size=128)


@pytest.fixture(scope="module")
def page(face_folder):
    return report.write_report(face_folder).path


def show(browser, page):
    """Open a page in a usual window, and wait for its first picture; return the browser."""
    browser.look(1400, 1000)
    browser.open(page)
    browser.wait(f"{FIRST}.painter")
    return browser


@pytest.fixture
def opened(browser, page):
    return show(browser, page)


def pixels(browser, **state):
    """Return (H, W, 4) what the viewer draws in a state, row 0 on top."""
    text = browser.run(
        f"(() => {{ let text = ''; for (const byte of {FIRST}.pixels({SIZE}, {json.dumps(state)})) "
        "text += String.fromCharCode(byte); return btoa(text); })()"
    )
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(SIZE, SIZE, 4)[::-1].astype(float)


def shown(browser):
    return np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB")).astype(float)


def lamps(lights):
    """Return lights as the page's state has them."""
    return [
        {
            "azimuth": math.degrees(light.azimuth_rad),
            "elevation": math.degrees(light.elevation_rad),
            "distance": None if math.isinf(light.distance_mm) else light.distance_mm,
            "intensity": light.intensity,
            "on": True,
        }
        for light in lights
    ]


def compared(browser, relit, camera=None, **state):
    """Return the library's picture, the page's, where both show the face, and their differences there."""
    picture = relit.picture(camera, shape=(SIZE, SIZE))
    drawn = pixels(browser, exposure=-1, **state)
    inside = (picture.alpha == 1) & (drawn[..., 3] == 255)
    return picture, drawn, inside, np.abs(drawn[..., :3] - picture.srgb(0.5))[inside].max(-1)


SIDE = light_at(60, 20, intensity=2.5)
PLAIN = RelightOptions(gloss="found", fill_gaps=False)
TWO = [light_at(-60, 30, intensity=2.0), light_at(40, -10, distance_mm=700.0, intensity=1.5)]
CASES = {
    "as scanned": ((0, 0), (), True),
    "hard light from the side": ((0, 0), [SIDE], True),
    "without shadows": ((0, 0), [SIDE], False),
    "two lights, one near, turned": ((35, 10), TWO, True),
    "from above, seen from below": ((-20, -15), [light_at(0, 65, intensity=2.5)], True),
}


@pytest.mark.parametrize("case", CASES)
def test_the_picture_is_the_librarys(opened, face_folder, case):
    (azimuth, elevation), given, shadows = CASES[case]
    face = load_result(face_folder)
    lights = list(given or face.lights)
    camera = default_camera(
        face, (SIZE, SIZE), azimuth_rad=math.radians(azimuth), elevation_rad=math.radians(elevation)
    )
    relit = relight(replace(face, casts_shadows=shadows), lights, options=PLAIN)
    view = {"azimuth": azimuth, "elevation": elevation, "zoom": 1}
    off = {**lamps([SIDE])[0], "on": False}
    state = {"mode": "relit", "ambient": 1, "shadows": shadows, "view": view, "lights": [*lamps(lights), off]}
    picture, drawn, inside, off = compared(opened, relit, camera, **state)
    assert inside.mean() > 0.25
    assert ((picture.alpha > 0.5) != (drawn[..., 3] > 127)).mean() < 0.01
    # In steps of 8 bits; shadows differ on their outlines alone.
    assert np.median(off) <= 1
    assert off.mean() < 1.5
    assert np.mean(off > 16) < 0.015


def test_every_mode_draws_something_else(opened):
    modes = opened.run("[...document.querySelectorAll('.modes input')].map(radio => radio.value)")
    assert modes == ["relit", "albedo", "scanned", "light", "normals"]
    drawn = [pixels(opened, mode=mode) for mode in modes]
    for k in range(len(drawn)):
        for other in drawn[:k]:
            # As scanned and relit as scanned are to be alike, and no more than that.
            assert np.abs(drawn[k] - other).max() > 2
    # The synthetic texture has a scale of its own, so the two agree up to that.
    relit = pixels(opened, mode="relit", exposure=-2)
    both = np.stack([picture[relit[..., 3] == 255][:, :3].ravel() for picture in (relit, drawn[2])])
    assert np.corrcoef(both)[0, 1] > 0.98


def test_dragging_wheel_keys_and_double_click_turn_and_reset(opened):
    browser = opened
    before = shown(browser)
    x, y = browser.run(
        "(() => { const b = document.querySelector('.stage').getBoundingClientRect();"
        "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    )
    browser.drag(x, y, 120, 30)
    view = browser.run(f"{FIRST}.state.view")
    assert view["azimuth"] < -10
    assert view["elevation"] > 2
    browser.run("new Promise(done => setTimeout(done, 100))")
    assert np.abs(shown(browser) - before).mean() > 1
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-120)
    browser.wait(f"{FIRST}.state.view.zoom > 1.1")
    browser.run("document.querySelector('.stage').focus()")
    browser.key("ArrowRight")
    assert browser.run(f"{FIRST}.state.view.azimuth") == pytest.approx(view["azimuth"] + 5)
    azimuth = browser.run(f"{FIRST}.state.lights[0].azimuth")
    browser.key("ArrowRight", shift=True)
    assert browser.run(f"{FIRST}.state.lights[0].azimuth") == pytest.approx(azimuth + 5)
    for count in (1, 2):
        browser.mouse("mousePressed", x, y, clickCount=count)
        browser.mouse("mouseReleased", x, y, clickCount=count)
    assert browser.run(f"{FIRST}.state.view") == FRONT


def test_controls_change_the_light_and_the_presets_bring_it_back(opened):
    scanned = pixels(opened)
    opened.run(
        "(() => { const s = document.querySelector('.light-detail input[type=range]'); s.value = -80;"
        "s.dispatchEvent(new Event('input')); })()"
    )
    assert opened.run(f"{FIRST}.state.lights[0].azimuth") == -80
    assert np.abs(pixels(opened) - scanned).mean() > 2
    opened.run(f"{PRESETS}[0].click()")
    assert opened.run(f"{PRESETS}[0].getAttribute('aria-pressed')") == "true"
    assert np.abs(pixels(opened) - scanned).max() == 0
    opened.run("[...document.querySelectorAll('.chip')].at(-1).click()")
    assert opened.run(f"{FIRST}.state.lights.length") == 3
    for _ in range(3):
        opened.run("document.querySelector('.light-detail button').click()")
    assert opened.run(f"{FIRST}.state.lights.length") == 0
    assert np.abs(pixels(opened) - scanned).mean() > 2


def test_presets_expose_themselves_and_left_is_the_subjects(opened):
    labels = opened.run(f"{PRESETS}.map(button => button.textContent)")
    assert labels[0] == "As scanned"
    halves = {}
    for k, label in enumerate(labels[1:], start=1):
        opened.run(f"{PRESETS}[{k}].click()")
        assert opened.run(f"{FIRST}.state.autoExposure")
        drawn = pixels(opened)
        inside, bright = drawn[..., 3] == 255, drawn[..., :3].max(-1)
        # The exposure puts four fifths of a face of the mean albedo below 0.4 of white, 170 of 255.
        assert 130 < np.percentile(bright[inside], 80) < 215, label
        halves[label] = [bright[:, side][inside[:, side]].mean() for side in (slice(128), slice(128, None))]
    # From the front the subject's left is on the right of the picture.
    assert halves["Left"][1] > halves["Left"][0] + 20
    assert halves["Right"][0] > halves["Right"][1] + 20
    opened.run(f"{PRESETS}[0].click()")
    assert not opened.run(f"{FIRST}.state.autoExposure")


def test_soft_light_is_shown_with_what_the_face_hides_of_it(browser, write_scan, tmp_path):
    coefficients = np.zeros((9, 3))
    coefficients[0] = (0.8, 1.0, 1.2)
    coefficients[1, 0] = 0.3
    coefficients[3, 2] = 0.3
    soft = EnvironmentLight(coefficients)
    folder = write_scan(tmp_path / "soft", size=128, lights=(), environment=soft)
    show(browser, report.write_report(folder).path)
    relit = relight(load_result(folder), environment=soft, options=PLAIN)
    *_, off = compared(browser, relit, mode="relit", view=FRONT)
    *_, open_off = compared(browser, relit, view=FRONT, shadows=False)
    assert np.median(off) <= 3
    assert off.mean() < 0.5 * open_off.mean()


def test_relit_pictures_show_what_the_command_assumes_until_its_box_is_cleared(browser, write_scan, tmp_path):
    folder = write_scan(
        tmp_path / "assumed",
        size=128,
        options={"model": s2a.AnnotatedFaceModel.default().name},
        parameters={"brdf": "lambert", "sigma_rad": 0.0, "specular_strength": 0.0, "specular_exponent": 1.0},
    )
    # A fitted face whose chin was not seen, and is black.
    image, albedo = read_image_and_albedo(folder)
    unseen = image.mask & (image.position[..., 1] < np.quantile(image.position[image.mask, 1], 0.1))
    image = replace(image, occluder=None, texture_valid=image.mask & ~unseen)
    write_geometry_image(folder / "geometry_image.npz", image)
    write_exr(folder / "albedo.exr", np.where(unseen[..., None], 0, albedo))
    mesh = FaceMesh.of_chart(image)
    write_glb(folder / "fitted.glb", mesh.vertices, mesh.faces, mesh.uv, np.zeros((8, 8, 3), np.uint8))

    show(browser, report.write_report(folder).path)
    words = browser.run("document.querySelector('main').textContent")
    face, lights = load_result(folder), [light_at(-30, 20, intensity=2.0)]
    state = {"mode": "relit", "ambient": 1, "lights": lamps(lights), "harmonic": False}
    pictures = {}
    for options in (RelightOptions(), PLAIN):
        relit, assumed = relight(face, lights, options=options), options.fill_gaps
        _, drawn, inside, off = compared(browser, relit, **state)
        assert np.median(off) <= 1
        assert off.mean() < 1.5
        assert len(relit.notes) == (2 if assumed else 0)
        assert all(note in words for note in relit.notes)
        pictures[assumed] = drawn[inside]
        box = "[...document.querySelectorAll('label')].find(l => l.textContent.includes('assumed: '))"
        assert browser.run(f"{box}.textContent") == " assumed: filled gaps and skin's usual gloss"
        browser.run(f"{box}.click()")
    assert (pictures[True] > pictures[False] + 20).mean() > 0.03
    # The albedo itself shows no guess.
    assert np.mean(pixels(browser, mode="albedo", assumed=True)[..., :3].max(-1)[inside] < 2) > 0.03


@pytest.mark.parametrize("width", [1400, 400])
def test_both_schemes_fit_the_window(browser, page, width):
    grounds = []
    for dark in (False, True):
        browser.look(width, 900, dark=dark, phone=width == 400)
        browser.open(page)
        browser.wait(f"{FIRST}.painter")
        assert browser.run("document.documentElement.scrollWidth") <= width
        grounds.append(shown(browser)[2, 2].mean())
    assert grounds[0] > 200
    assert grounds[1] < 60


@pytest.fixture(scope="module")
def batch(some_scans, write_scan, tmp_path_factory):
    out = tmp_path_factory.mktemp("batch")
    write_scan(out / "evil", name=EVIL)
    for folder in some_scans.iterdir():
        if folder.is_dir():
            (out / folder.name).symlink_to(folder)
    return report.write_report(out).path


NAMES = "[...document.querySelectorAll('.scan-table tbody th')].map(cell => cell.textContent)"


def test_the_table_is_sorted_filtered_and_leads_to_the_scans(browser, batch):
    browser.look(1400, 1000)
    browser.open(batch)
    heads = browser.run("[...document.querySelectorAll('.scan-table thead button')].map(b => b.textContent)")
    column = heads.index("Fit, mean mm")
    browser.run(f"document.querySelectorAll('.scan-table thead button')[{column}].click()")
    assert browser.run(NAMES) == ["scan-1", "scan-3", "scan-2", EVIL, "scan-0", "scan-9"]
    browser.run(f"document.querySelectorAll('.scan-table thead button')[{column}].click()")
    assert browser.run(NAMES) == ["scan-0", EVIL, "scan-2", "scan-3", "scan-1", "scan-9"]
    browser.run("document.querySelector('.failures-first').click()")
    assert browser.run(NAMES)[0] == "scan-9"
    browser.run("document.querySelector('[data-show=failed]').click()")
    assert browser.run(NAMES) == ["scan-9"]
    browser.run(
        "document.querySelector('[data-show=\"\"]').click();"
        "(() => { const s = document.querySelector('[type=search]'); s.value = 'SCAN-2';"
        "s.dispatchEvent(new Event('input')); })()"
    )
    assert browser.run(NAMES) == ["scan-2"]
    assert browser.run("document.querySelector('.counted').textContent") == "1 of 6 scans"
    browser.run("document.querySelector('.scan-table tbody a').click()")
    browser.wait("document.querySelector('details[open] canvas')")
    assert browser.run("document.querySelector('details[open] .scan-name').textContent") == "scan-2"
    assert browser.run("document.title") != "broken"


def test_only_some_viewers_stay_awake(browser, batch):
    browser.look(1400, 1000)
    browser.open(batch)
    browser.run("document.querySelectorAll('details.scan').forEach(section => { section.open = true; })")
    for _ in range(2):
        for k in range(5):
            browser.run(f"document.querySelectorAll('.stage')[{k}].scrollIntoView({{behavior: 'instant'}})")
            browser.wait(f"[...scan2albedo.viewers.values()][{k}].painter")
    assert browser.run("[...scan2albedo.viewers.values()].filter(viewer => viewer.painter).length") <= 4
