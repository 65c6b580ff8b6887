"""A simulation to look at and to steer, in the browser."""

from __future__ import annotations

import collections
import importlib
import queue
import threading
import time
import types
from typing import Any

import numpy as np

from ..errors import InputError, SimulationError, brief, integer, missing_extra
from ..simulation.state import Trajectory
from .camera import VIEW, Camera
from .geometry import OBSTACLE_COLOR, in_view, placed
from .solids import solid
from .yarns import Tubes, Weaving

Simulator = Any
"""This room imports none."""
FRAME_TIME = 1.0 / 30.0
"""Least time from picture to picture [s]: more than browsers show."""
KEPT = 300
"""Pictures whose energies are in the chart."""
DETAIL = ((20_000, 5, 10), (100_000, 3, 8), (float("inf"), 2, 6))
"""Most segments of yarn, and rings a segment and corners of a ring for so many: what a browser draws without effort."""


def view(simulator: Simulator, *, port: int = 8080, host: str = "127.0.0.1") -> Viewer:
    """Shows a simulation in the browser, at http://host:port, with its energies: it is played, stepped, reset, and
    simulated on without some of its terms, from there or by the viewer that this returns.

    Needs the extra ``view``. The simulation runs in a thread of its own until the viewer is closed, or the program
    ends: ``wy.view(simulator).wait()`` keeps a script alive until Ctrl-C.

    Args:
        simulator: what to show; nobody else should run it meanwhile.
        port: where the browser finds it, from 1 to 65535; the next one that is free.
        host: who may look: "127.0.0.1", this machine alone; "0.0.0.0", all that reach it.

    Raises:
        InputError: an argument is out of its range, or viser is not installed.
    """
    port = integer("port", port, least=1, most=65535)
    if not hasattr(simulator, "scene") or not callable(getattr(simulator, "run", None)):
        raise InputError(f"simulator = {brief(simulator)}, must be a Simulator")
    return Viewer(simulator, _viser(), port, host)


class Viewer:
    """A simulation in the browser, as ``wy.view`` makes it.

    Attributes:
        simulator: what is shown; another one once terms were switched.
        url: where the browser finds it.
        message: what the browser says of its state.
    """

    def __init__(self, simulator: Simulator, viser: types.ModuleType, port: int, host: str):
        self.simulator, self.message = simulator, ""
        self.terms = tuple(simulator.scene.terms)
        self._start, self._started = simulator.state, simulator.steps_done
        self.playing = False
        self._commands: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._server = viser.ViserServer(host=host, port=port, label="warp_yarn", verbose=False)
        self.url = f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{self._server.get_port()}"
        self.page = _Page(self, self._server)
        self._show()
        self._thread = threading.Thread(target=self._run, name="warp_yarn view", daemon=True)
        self._thread.start()

    # -- what others may call ----------------------------------------------------------------------------------------

    def picture(self) -> None:
        """Makes the steps of a picture."""
        self._put(self._picture)

    def play(self) -> None:
        """Runs until it is paused, or a step fails."""
        self._put(lambda: self._set_playing(True))

    def pause(self) -> None:
        """Stops after the steps of the next picture."""
        self._put(lambda: self._set_playing(False))

    def step(self, steps: int = 1) -> None:
        """Makes so many steps, at least 1, and waits for them."""
        steps = integer("steps", steps, least=1)
        self._put(lambda: self._advance(steps))
        self.flush()

    def reset(self) -> None:
        """Goes back to where the simulator was when the viewer was made."""
        self._put(self._go_back)

    def switch(self, term: str, on: bool) -> None:
        """Simulates on with a term of the scene, or without it."""
        if term not in self.terms:
            raise InputError(f"term = {term!r}, must be one of {', '.join(self.terms)}")
        self._put(lambda: self._switch(term, on))

    def flush(self) -> None:
        """Waits until all that was asked for before is done."""
        done = threading.Event()
        self._put(done.set)
        while not done.wait(0.1):
            if not self._thread.is_alive():
                return

    def wait(self) -> None:
        """Waits until the viewer is closed, or Ctrl-C comes, which closes it."""
        print(f"{self.url}: Ctrl-C ends it.")
        try:
            while self._thread.is_alive():
                self._thread.join(0.5)
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Ends the thread and the server. The simulator stays where it is."""
        if self._thread.is_alive():
            self._put(None)
            self._thread.join()
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- the thread that simulates -----------------------------------------------------------------------------------

    def _put(self, command: Any) -> None:
        self._commands.put(command)

    def _run(self) -> None:
        last = 0.0
        while True:
            try:
                command = self._commands.get(block=not self.playing)
            except queue.Empty:
                command = self._picture
            if command is None:
                return
            try:
                command()
            except Exception as error:  # whatever it is, the browser says it and the next command is obeyed
                self._set_playing(False)
                self._show(f"It failed in {error}" if isinstance(error, SimulationError) else repr(error))
            time.sleep(max(0.0, last + FRAME_TIME - time.perf_counter()) if self.playing else 0.0)
            last = time.perf_counter()

    def _picture(self) -> None:
        """Makes the steps of a picture."""
        self._advance(int(self.page.rate.value))

    def _set_playing(self, playing: bool) -> None:
        self.playing = playing
        self.page.play.label = "Pause" if playing else "Play"

    def _show(self, message: str | None = None) -> None:
        """Shows the present state."""
        steps = self.simulator.steps_done
        self.page.show(self.simulator)
        self._say(message or f"{1e3 * steps * self.simulator.step_size:.1f} ms, {steps} steps")

    def _say(self, message: str) -> None:
        self.message = message
        self.page.status.content = message

    def _advance(self, steps: int) -> None:
        self.simulator.run(steps)
        self._show()

    def _go_back(self) -> None:
        self.simulator.state, self.simulator.steps_done = self._start, self._started
        self.page.history.clear()
        self._show()

    def _switch(self, term: str, on: bool) -> None:
        present = [t for t in self.terms if (on if t == term else t in self.simulator.scene.terms)]
        state, steps = self.simulator.state, self.simulator.steps_done
        self._say(f"compiling without {', '.join(sorted(set(self.terms) - set(present))) or 'nothing'} …")
        try:
            other = type(self.simulator)(self.simulator.scene.replace(terms=present), **self.simulator._options)
            other.state, other.steps_done = state, steps
        except (InputError, SimulationError) as error:
            self.page.boxes[term].value = not on
            self._say(str(error))
            return
        self.simulator = other
        self.page.boxes[term].value = on
        self._show()


class _Page:
    """What the browser shows of a viewer."""

    def __init__(self, viewer: Viewer, server: Any):
        self.viewer, self.server = viewer, server
        self._draw(viewer.simulator)
        self._add_controls()

    def _draw(self, simulator: Simulator) -> None:
        scene, cloth = self.server.scene, simulator.scene.cloth
        scene.set_up_direction("+z")
        self._weaving = Weaving(cloth)
        segments = len(cloth.topology.segment_nodes)
        samples, self._sides = next((s, c) for most, s, c in DETAIL if segments <= most)
        self._tubes = [Tubes.around(strands, samples=samples) for strands in self._weaving.strands]
        look = self._weaving.look(simulator.state.position)
        half = max(float(strands.half.max()) for strands in self._weaving.strands)
        points = np.concatenate([strands.points(*look) for strands in self._weaving.strands])
        # square, since the controls take a side of the window
        beside = in_view(placed(_frame(simulator)), points.min(axis=0), points.max(axis=0))
        camera = Camera.framing([points, *beside], half, 1.0, VIEW, lens=45.0)
        # a browser's camera sees nothing that is as near as a cloth of centimetres is
        self._scale = 1.0 / max(float(np.ptp(points, axis=0).max()), np.finfo(float).tiny)
        self._origin = np.array(camera.target)
        self.server.initial_camera.position = tuple(self._shown(np.array(camera.position)).tolist())
        self.server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self.server.initial_camera.up = (0.0, 0.0, 1.0)
        self.server.initial_camera.fov = float(np.radians(45.0))
        self._meshes = [
            scene.add_mesh_simple(
                f"/cloth/yarn_{tubes.strands.material}",
                self._vertices(tubes, look),
                _all_triangles(tubes, self._sides),
                color=_bytes(tubes.strands.color),
                side="double",
            )
            for tubes in self._tubes
        ]
        self._obstacles = []
        for k, each in enumerate(placed(_frame(simulator))):
            vertices, _, faces = solid(each)
            name = f"/obstacles/{each.obstacle.shape}_{k}"
            mesh = scene.add_mesh_simple(
                name, self._scale * vertices, faces, color=_bytes(OBSTACLE_COLOR), flat_shading=True, side="double"
            )
            self._obstacles.append(mesh)

    def _add_controls(self) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("")
        self.play = gui.add_button("Play")
        self.play.on_click(lambda _: self.viewer.pause() if self.viewer.playing else self.viewer.play())
        gui.add_button("Step").on_click(lambda _: self.viewer.picture())
        gui.add_button("Reset").on_click(lambda _: self.viewer.reset())
        self.rate = gui.add_slider("Steps a picture", 1, 50, 1, 5)
        self.boxes = {}
        with gui.add_folder("Terms"):
            for term in self.viewer.terms:
                box = gui.add_checkbox(term, True)
                box.on_update(lambda event, term=term: self._asked(event, term))
                self.boxes[term] = box
        self.history: collections.deque[tuple[float, ...]] = collections.deque(maxlen=KEPT)
        with gui.add_folder("Energies"):
            self._table = gui.add_markdown("")
            series = (
                {"label": "ms"},
                {"label": "kinetic, µJ", "stroke": "#218f91"},
                {"label": "all, µJ", "stroke": "#f57d5e"},
            )
            self._chart = gui.add_uplot((np.zeros(1),) * 3, series, aspect=1.6)

    def _asked(self, event: Any, term: str) -> None:
        """Switches a term that somebody ticked: not where this side did."""
        if event.client is not None:
            self.viewer.switch(term, self.boxes[term].value)

    def show(self, simulator: Simulator) -> None:
        """Shows the present state."""
        look = self._weaving.look(simulator.state.position)
        with self.server.atomic():
            for mesh, tubes in zip(self._meshes, self._tubes, strict=True):
                mesh.vertices = self._vertices(tubes, look)
            if self._obstacles:
                for mesh, each in zip(self._obstacles, placed(_frame(simulator)), strict=True):
                    x, y, z, w = each.rotation[0].tolist()
                    mesh.wxyz = (w, x, y, z)
                    mesh.position = tuple(self._shown(each.position[0]).tolist())
        energies = {name: 1e6 * value for name, value in simulator.energy().items()}
        rows = [f"| {name.replace('mass', 'kinetic')} | {value:.4g} |" for name, value in energies.items()]
        self._table.content = "\n".join(["| | µJ |", "|---|---|", *rows])
        time = 1e3 * simulator.steps_done * simulator.step_size
        self.history.append((time, energies.get("mass", 0.0), sum(energies.values())))
        self._chart.data = tuple(np.array(column) for column in zip(*self.history, strict=True))

    def _vertices(self, tubes: Tubes, look: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return self._shown(tubes.vertices(*look, self._sides)).astype(np.float32)

    def _shown(self, points: np.ndarray) -> np.ndarray:
        """Gives points in the browser's coordinates, in which a cloth is about 1 large."""
        return self._scale * (points - self._origin)


def _frame(simulator: Simulator) -> Trajectory:
    """Makes a trajectory of the present state."""
    state = simulator.state
    names = ("position", "euler", "velocity", "euler_velocity", "anchor")
    parts: dict[str, Any] = {name: getattr(state, name)[None] for name in names}
    scene = simulator.scene
    return Trajectory(scene.cloth, simulator.step_size, **parts, scene=scene, start=simulator.steps_done)


def _all_triangles(tubes: Tubes, sides: int) -> np.ndarray:
    """Lists the faces of tubes, and of their caps on the same vertices, as triangles [triangles, 3]."""
    rings, _ = tubes.capped
    faces = tubes.triangles(sides)
    return (rings[faces // sides] * sides + faces % sides).astype(np.uint32)


def _bytes(color: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * each) for each in color)
    return red, green, blue


def _viser() -> types.ModuleType:
    try:
        return importlib.import_module("viser")
    except ImportError as error:
        raise missing_extra("viser", "viewing needs", "view") from error
