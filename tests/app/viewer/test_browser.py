"""The live view in Chromium: what a user sees and does with the mouse."""

import io
import shutil
import time

import numpy as np
import pytest
from matplotlib.image import imread

import hybridkin
from hybridkin import plots, robots

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
    return page


def picture(page):
    """Return the pixels of the robot's half of the page."""
    shot = page.screenshot(clip={"x": 0, "y": 180, "width": 740, "height": 480})
    return imread(io.BytesIO(shot))[..., :3]


def until(condition, seconds=15.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def place_on_page(shown, point):
    """Return where a point [m] is on the page, from the camera of the only client."""
    (client,) = shown._server.get_clients().values()
    camera = client.camera
    forward = camera.look_at - camera.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right = right / np.linalg.norm(right)
    up = np.cross(right, forward)
    way = point - camera.position
    scale = 360.0 / np.tan(camera.fov / 2) / (way @ forward)
    return 550.0 + scale * (way @ right), 360.0 - scale * (way @ up)


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
    x, y = place_on_page(shown, shown.robot.target + arrow)
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
    page.goto(film.save(tmp_path / "track.html").as_uri())
    page.wait_for_selector("canvas")
    page.wait_for_timeout(2500)
    before = picture(page)
    assert (before.std(axis=(0, 1)) > 0.02).any()
    page.wait_for_timeout(1500)
    assert (np.abs(picture(page) - before).max(axis=-1) > 0.2).sum() > 50
    assert not [url for url in requests if url.startswith("http")]
    page.close()
