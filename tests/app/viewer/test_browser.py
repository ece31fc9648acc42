"""The live view in Chromium: what a user sees and does with the mouse.

The pictures of docs/view.md come from here: `make view-test PICTURES=docs/images`.
"""

import io
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from view_scenes import SCENES

import hybridkin.app
from hybridkin import plots, robots
from hybridkin.plots.page_server import Camera

pytestmark = [pytest.mark.browser, pytest.mark.slow]
sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: `make view-test`")
pytest.importorskip("viser", reason='needs viser: pip install "hybridkin[view]"')
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
OPTIONS = [
    *("--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("needs Chromium: on Debian `apt install chromium`")
    with sync_api.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield chromium
        chromium.close()


@pytest.fixture
def shown():
    chain = robots.bionic_handling_assistant()
    with hybridkin.app.view(chain, q_min=0.1, q_max=0.4, port=9400) as view:
        yield view


@pytest.fixture
def page(browser, shown):
    page = opened(browser, shown)
    yield page
    page.close()


def opened(browser, shown):
    """Return a page that shows the robot."""
    page = browser.new_page(viewport={"width": 1100, "height": 720})
    page.goto(shown.address)
    page.wait_for_selector("canvas")
    page.get_by_text("Wiggle every actuator").wait_for()
    page.wait_for_timeout(2500)
    notice = page.get_by_role("alert").get_by_role("button")  # this machine has no graphics card
    if notice.count():
        notice.first.click()
    return page


def pixels(shot):
    """Return the colours (height, width, 3) of a screenshot, from 0 to 1."""
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")) / 255.0


def picture(page):
    """Return the pixels of the robot's part of the page."""
    return pixels(page.screenshot(clip={"x": 0, "y": 0, "width": 740, "height": 660}))


def until(condition, seconds=15.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def camera_of(shown):
    """Return the camera of the only client, and the size of its canvas [pixel]."""
    (client,) = shown._server.get_clients().values()
    camera = client.camera
    size = np.array([camera.image_width, camera.image_height])
    return Camera(camera.position, camera.look_at), size


def place_on_page(shown, points):
    """Return where points (N, 3) [m] are on the page (N, 2) [pixel]."""
    camera, size = camera_of(shown)
    on_page = camera.on_page(points, size[0] / size[1])
    return 0.5 * size * (1.0 + on_page * [1.0, -1.0])


def test_the_page_draws_the_robot_and_a_slider_moves_it(page, shown):
    before = picture(page)
    assert (before.std(axis=(0, 1)) > 0.02).any()  # not one colour
    q = shown.robot.q.copy()
    slider = page.get_by_role("slider").first
    slider.focus()
    for _ in range(60):
        slider.press("ArrowRight")
    until(lambda: shown.robot.q[0] > q[0] + 0.01)
    until(lambda: shown.robot._resting)
    page.wait_for_timeout(1500)
    assert (np.abs(picture(page) - before).max(axis=-1) > 0.2).sum() > 50


def test_dragging_the_target_moves_the_tip(page, shown):
    before = shown.robot.x.copy()
    arrow = 0.1 * shown.robot.size * np.array([0.0, 0.0, 1.0])
    ((x, y),) = place_on_page(shown, [shown.robot.target + arrow])
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 30, steps=10)
    page.mouse.up()
    until(lambda: not np.allclose(shown.robot.target, before, atol=5e-3))
    until(lambda: shown.robot._resting)
    assert np.linalg.norm(shown.robot.x - shown.robot.target) < 1e-3
    page.get_by_text("On target").wait_for()


def test_two_clients_see_the_same_robot_and_a_reload_comes_back(browser, page, shown):
    second = opened(browser, shown)
    shown.follow(shown.robot.x + np.array([0.1, 0.0, 0.0]))
    until(lambda: shown.robot.situation.reached)
    page.reload()
    for each in (page, second):
        each.get_by_text("On target").wait_for(timeout=20_000)
    assert len(shown._server.get_clients()) == 2
    second.close()
    until(lambda: len(shown._server.get_clients()) == 1)


def test_the_page_of_a_track_plays_without_a_server(browser, tmp_path):
    chain = robots.bionic_handling_assistant()
    q = np.linspace(np.full(9, 0.2), [0.3, 0.2, 0.2] * 3, 40)
    film = plots.TrackAnimation.from_estimator(chain, q, t=np.linspace(0.0, 4.0, 40))
    page = browser.new_page(viewport={"width": 1100, "height": 720})
    requests = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(film.save(tmp_path / "track.html", title="a <track>").as_uri())
    page.wait_for_selector("canvas")
    page.wait_for_timeout(2500)
    assert page.title() == "a <track>"
    before = picture(page)
    assert (before.std(axis=(0, 1)) > 0.02).any()
    page.wait_for_timeout(1500)
    assert (np.abs(picture(page) - before).max(axis=-1) > 0.2).sum() > 50
    assert not [url for url in requests if url.startswith("http")]
    page.close()


def drawn_share(page, shown):
    """Return the share of the canvas, in width and in height, that is not white."""
    _, (width, height) = camera_of(shown)
    clip = {"x": 0, "y": 0, "width": int(width), "height": int(height) - 90}  # without the axes
    is_drawn = pixels(page.screenshot(clip=clip)).min(axis=-1) < 0.9
    spans = [np.ptp(np.flatnonzero(is_drawn.any(axis=axis))) for axis in (0, 1)]
    return np.array(spans) / [width, height]


@pytest.mark.parametrize("name", SCENES)
def test_the_first_look_shows_robot_and_log_and_fills_the_page(browser, name, request):
    if name == "view_recording":
        request.getfixturevalue("data_home")
    scene = SCENES[name]
    with scene.opened(9600) as shown:
        page = opened(browser, shown)
        assert page.title().endswith(" - hybridkin")
        seen = [shown._body.points, shown.robot.base[None, :3, 3]]
        if shown._rows is not None:
            seen.append(shown._rows.tips)
        places = place_on_page(shown, np.concatenate(seen))
        _, size = camera_of(shown)
        assert (places > 0.04 * size).all()
        assert (places < 0.96 * size).all()
        assert size[0] < 800  # the panel stands beside the robot
        assert drawn_share(page, shown).max() > 0.6

        def click(point):
            ((x, y),) = place_on_page(shown, [point])
            page.mouse.click(x, y)
            until(lambda: shown._measured.visible)

        scene.act(shown, page, click)
        page.wait_for_timeout(300)
        until(lambda: shown.robot._resting, 60.0)
        page.wait_for_timeout(1500)
        shot = page.screenshot()
        assert (pixels(shot).std(axis=(0, 1)) > 0.02).any()
        if os.environ.get("HYBRIDKIN_PICTURES"):
            colors = Image.open(io.BytesIO(shot)).convert("RGB").quantize(128)
            colors.save(Path(os.environ["HYBRIDKIN_PICTURES"]) / f"{name}.png", optimize=True)
        page.close()


def test_the_page_of_a_phone_shows_the_whole_robot(browser):
    with SCENES["view_target"].opened(9650) as shown:
        page = browser.new_page(viewport={"width": 420, "height": 800})
        page.goto(shown.address)
        page.wait_for_selector("canvas")
        until(lambda: len(shown._server.get_clients()) == 1)
        page.wait_for_timeout(2500)
        places = place_on_page(shown, shown._body.points)
        _, size = camera_of(shown)
        assert (places > 0.0).all()
        assert (places < size).all()
        page.close()
