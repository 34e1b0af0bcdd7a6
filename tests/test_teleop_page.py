"""The page in a real browser: it loads, a handle, a slider and a key move the arm, and it can be seen."""

from __future__ import annotations

import io
import shutil
import threading
import time

import numpy as np
import pytest

from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.errors import ParameterError
from grr_torch.interactive.drive import drive
from grr_torch.interactive.session import Session

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
WIDTH, HEIGHT = 1100, 700

pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture(scope="module")
def opened(kinova_roadmap):
    """A page that is driven in the background, and its session."""
    from grr_torch.interactive.page import Page

    session = Session(Teleoperator(kinova_roadmap))
    page = Page(session, port=0)
    stop = threading.Event()
    loop = threading.Thread(target=drive, args=(session, page.show, stop))
    loop.start()
    yield page, session
    stop.set()
    loop.join()
    page.close()


@pytest.fixture(scope="module")
def browser_page(opened, tmp_path_factory):
    """The page in Chromium, loaded."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    profile = tmp_path_factory.mktemp("chromium")
    with api.sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile, executable_path=CHROMIUM, args=FLAGS.split(), viewport={"width": WIDTH, "height": HEIGHT}
        )
        page = context.pages[0]
        page.set_default_timeout(90_000)
        page.goto(opened[0].url)
        page.wait_for_selector("#grr-status")
        yield page
        context.close()


def wait_until(condition, page, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        page.wait_for_timeout(50)
    assert condition()


def pixel(opened, place):
    """Where a point of space (3,) is on the screen."""
    (client,) = opened[0]._server.get_clients().values()
    camera = client.camera
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right /= np.linalg.norm(right)
    seen = np.asarray(place) - camera.position
    depth = seen @ forward
    scale = 0.5 * HEIGHT / np.tan(0.5 * camera.fov) / depth
    return 0.5 * WIDTH + scale * (seen @ right), 0.5 * HEIGHT - scale * (seen @ np.cross(right, forward))


def settled(opened, page):
    """Waits until the arm has arrived; its configuration."""
    session = opened[1]
    wait_until(lambda: np.linalg.norm(np.subtract(session.tool, session.target)) < 2e-3, page)
    return session.configuration


def test_the_page_shows_the_arm_and_its_status(opened, browser_page):
    from PIL import Image

    wait_until(lambda: browser_page.inner_text("#grr-status") == "tracking", browser_page)
    assert float(browser_page.inner_text("#grr-step")) > 0.0
    assert float(browser_page.inner_text("#grr-clearance")) > 0.0
    wait_until(lambda: bool(opened[0]._server.get_clients()), browser_page)

    def shades():
        picture = np.asarray(Image.open(io.BytesIO(browser_page.screenshot())).convert("RGB"))
        # what is in the middle, beside the panel: arm, handle and points
        middle = picture[HEIGHT // 5 : -HEIGHT // 5, WIDTH // 4 : -WIDTH // 3].reshape(-1, 3)
        return len(np.unique(middle // 16, axis=0))

    wait_until(lambda: shades() > 50, browser_page)


def test_dragging_the_handle_moves_the_arm(opened, browser_page):
    session = opened[1]
    wait_until(lambda: bool(opened[0]._server.get_clients()), browser_page)
    before, target = settled(opened, browser_page), np.array(session.target)
    # the arrow upwards, about two thirds of the way to its tip
    length = 0.16 * opened[0]._size()
    start = pixel(opened, target + np.array([0.0, 0.0, 0.7 * length]))
    mouse = browser_page.mouse
    for _ in range(3):
        mouse.move(*start)
        browser_page.wait_for_timeout(300)
        mouse.down()
        for k in range(1, 9):
            mouse.move(start[0], start[1] - 8 * k)
            browser_page.wait_for_timeout(60)
        mouse.up()
        browser_page.wait_for_timeout(500)
        if session.target[2] > target[2] + 0.02:
            break
    moved = np.array(session.target) - target
    assert moved[2] > 0.02
    assert np.abs(moved[:2]).max() < 1e-6
    assert float((settled(opened, browser_page) - before).abs().max()) > 0.02


def test_a_slider_and_keys_move_the_arm(opened, browser_page):
    session = opened[1]
    before, target = settled(opened, browser_page), np.array(session.target)
    browser_page.get_by_role("slider").first.focus()
    for _ in range(40):
        browser_page.keyboard.press("ArrowRight")
    wait_until(lambda: session.target[0] > target[0] + 0.03, browser_page)
    between = settled(opened, browser_page)
    assert float((between - before).abs().max()) > 0.02
    raised = session.target[2]
    browser_page.keyboard.press("u")
    wait_until(lambda: session.target[2] > raised + 0.005, browser_page)
    assert float((settled(opened, browser_page) - between).abs().max()) > 0.002


def test_the_clutch_and_the_boxes_can_be_clicked(opened, browser_page):
    page, session = opened
    browser_page.keyboard.press("c")
    wait_until(lambda: not session.engaged, browser_page)
    wait_until(lambda: browser_page.inner_text("#grr-status") == "holding", browser_page)
    browser_page.keyboard.press("c")
    wait_until(lambda: session.engaged, browser_page)
    browser_page.get_by_text("Broken edges").first.click()
    wait_until(lambda: page._map.parts["broken edges"].visible, browser_page)
    browser_page.get_by_text("Uncertified cells").first.click()
    wait_until(lambda: page._map.parts["uncertified cells"].visible, browser_page)


def test_steps_stay_within_the_velocity_limits(opened):
    session = opened[1]
    while len(session.log) < 3:
        time.sleep(0.05)
    steps = session.log.configurations.diff(dim=0).abs()
    assert bool((steps <= session.roadmap.robot.velocity_limits / session.rate + 1e-12).all())


def test_the_page_is_bound_to_loopback_and_a_port_in_use_is_refused(opened):
    from grr_torch.interactive.page import Page

    page, session = opened
    assert page.url.startswith("http://127.0.0.1:")
    with pytest.raises(ParameterError, match="in use"):
        Page(session, port=int(page.url.rsplit(":", 1)[1]))
    with pytest.raises(ParameterError, match="can be bound"):
        Page(session, host="no.such.host.invalid", port=0)


def test_a_page_of_a_planar_arm_has_two_sliders(planar_roadmap):
    from grr_torch.interactive.page import Page

    session = Session(Teleoperator(planar_roadmap))
    page = Page(session, port=0)
    try:
        page.show(session.tick())
        assert len(page._sliders) == 2
        assert page._handle.controls.active_axes == (True, True, False)
        assert "–" in page._words.content  # it has no clearance: there is no sphere model
    finally:
        page.close()
