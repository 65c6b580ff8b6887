"""Simulations in the browser: the viewer does what its simulator would, shows where yarns are, works in Chromium."""

import shutil
import socket
import sys
import time

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.view.yarns import Weaving

pytest.importorskip("viser")


def simulator(**options):
    cloth = wy.paper.cloth(rows=4, columns=5)
    return wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top"), **options))


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def viewer():
    with wy.view(simulator(), port=free_port()) as shown:
        yield shown


def test_it_steps_and_goes_back_as_its_simulator_would(viewer):
    alone = simulator()
    alone.run(5)
    viewer.step(2)
    viewer.step(3)
    assert viewer.simulator.steps_done == 5 and viewer.simulator.state == alone.state
    assert viewer.message == "5.0 ms, 5 steps"
    viewer.reset()
    viewer.flush()
    assert viewer.simulator.steps_done == 0 and viewer.simulator.state == simulator().state


def test_it_plays_until_it_is_paused(viewer):
    viewer.play()
    until = time.monotonic() + 60.0
    while viewer.simulator.steps_done < 20 and time.monotonic() < until:
        time.sleep(0.02)
    viewer.pause()
    viewer.flush()
    made = viewer.simulator.steps_done
    # whole pictures of five steps
    assert made >= 20 and made % 5 == 0
    time.sleep(0.2)
    assert viewer.simulator.steps_done == made


def test_terms_are_switched_off_and_on_where_the_cloth_is(viewer):
    viewer.step(3)
    state, terms = viewer.simulator.state, viewer.simulator.scene.terms
    viewer.switch("gravity", False)
    viewer.flush()
    assert viewer.simulator.scene.terms == tuple(t for t in terms if t != "gravity")
    assert viewer.simulator.state == state and viewer.simulator.steps_done == 3
    alone = wy.Simulator(viewer.simulator.scene)
    alone.state, alone.steps_done = state, 3
    alone.run(2)
    viewer.step(2)
    assert viewer.simulator.state == alone.state
    viewer.switch("gravity", True)
    viewer.flush()
    assert viewer.simulator.scene.terms == terms
    with pytest.raises(wy.InputError, match="term = 'magic', must be one of mass"):
        viewer.switch("magic", False)


def test_a_step_that_fails_stops_it_and_says_so(viewer, monkeypatch):
    def fails(steps):
        raise RuntimeError("it burst")

    monkeypatch.setattr(viewer.simulator, "run", fails)
    viewer.play()
    viewer.step()
    assert "it burst" in viewer.message
    monkeypatch.undo()
    viewer.step()
    assert viewer.message == "1.0 ms, 1 steps"


def test_what_the_browser_is_sent_is_where_yarns_are():
    """Also the obstacle, which moves; in coordinates in which the cloth is 1 large."""
    ball = wy.Sphere(center=(2e-3, 2e-3, 1e-3), radius=5e-4, path=[[2e-3, 2e-3, 1e-3 + 1e-4 * k] for k in range(1, 5)])
    with wy.view(simulator(obstacles=[ball]), port=free_port()) as viewer:
        get = viewer.page.server.scene.get_handle_by_name
        sent = {name: get(name) for name in ("/cloth/yarn_0", "/obstacles/sphere_0")}
        before = np.array(sent["/obstacles/sphere_0"].position)
        viewer.step(4)
        weaving = Weaving(viewer.simulator.scene.cloth)
        look = weaving.look(viewer.simulator.state.position)
        points = np.concatenate([strands.points(*look) for strands in weaving.strands])
        ratio = np.ptp(sent["/cloth/yarn_0"].vertices, axis=0)[0] / np.ptp(points, axis=0)[0]
        # the yarns' width is more than their points'
        assert 1.0 < ratio * np.ptp(points, axis=0).max() < 1.3
        moved = np.array(sent["/obstacles/sphere_0"].position) - before
        np.testing.assert_allclose(moved[:2], 0.0, atol=1e-12)
        # free ends that slope reach farther than their points
        assert moved[2] == pytest.approx(4e-4 * ratio, rel=0.15)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"port": 0}, "port = 0"),
        ({"port": "x"}, "port = 'x'"),
        ({"simulator": 3}, "simulator = 3, must be a Simulator"),
    ],
)
def test_wrong_arguments(options, message):
    with pytest.raises(wy.InputError, match=message):
        wy.view(options.pop("simulator", None) or simulator(), **options)


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(wy.InputError, match=r'viser is not installed.*pip install "\.\[view\]".*pip install "viser'):
        wy.view(simulator())


@pytest.mark.slow
def test_in_chromium(viewer):
    """The page shows the cloth in its colours, and its buttons and boxes do what they say."""
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-headless-shell")
    if chromium is None:
        pytest.skip("there is no Chromium")
    imageio = pytest.importorskip("imageio.v2")
    software = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=software)
        page = browser.new_page(viewport={"width": 900, "height": 600})
        page.goto(viewer.url)
        page.get_by_role("button", name="Step", exact=True).click(timeout=60_000)
        page.get_by_text("5 steps").wait_for(timeout=60_000)
        assert viewer.simulator.steps_done == 5
        page.get_by_label("gravity").click()
        until = time.monotonic() + 60.0
        while "gravity" in viewer.simulator.scene.terms and time.monotonic() < until:
            time.sleep(0.1)
        assert "gravity" not in viewer.simulator.scene.terms
        page.wait_for_timeout(3000)
        image = imageio.imread(page.screenshot())[..., :3].astype(int)
        browser.close()
    red, green, blue = image[:, :550].transpose(2, 0, 1)
    # coral and teal, of which either is at least a fiftieth of what is left of the controls
    assert ((red > blue + 40) & (red > green + 40)).mean() > 0.02
    assert ((blue > red + 40) & (green > red + 40)).mean() > 0.02
