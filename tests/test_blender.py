"""Blender imports USD files with the right radius, positions, materials and speed; and as docs/pictures.md says."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd
from waving import BLUE, RED, waving

import warp_yarn as wy
from warp_yarn.view.yarns import Weaving

pytestmark = pytest.mark.slow

BLENDER = sys.executable if importlib.util.find_spec("bpy") else os.environ.get("WARP_YARN_BPY")
"""A Python that has bpy: this one, or that which the environment variable names."""
PAGE = Path(__file__).parents[1] / "docs" / "pictures.md"

LOOK = """
import json, sys
import numpy as np

frames = json.loads(sys.argv[2])
scene = bpy.context.scene
found = {"fps": scene.render.fps / scene.render.fps_base, "end": scene.frame_end}
found["scale"] = scene.unit_settings.scale_length
found["shapes"] = [scene.cycles_curves.shape, scene.render.hair_type]
for frame in frames:
    scene.frame_set(int(frame), subframe=frame % 1.0)
    graph = bpy.context.evaluated_depsgraph_get()
    for thing in scene.objects:
        if thing.type not in ("CURVES", "MESH"):
            continue
        data = thing.evaluated_get(graph).data
        points = data.points if thing.type == "CURVES" else data.vertices
        place = np.zeros(3 * len(points))
        points.foreach_get("position" if thing.type == "CURVES" else "co", place)
        each = found.setdefault(thing.name, {"type": thing.type, "position": []})
        matrix = np.array(thing.evaluated_get(graph).matrix_world)
        each["position"].append((place.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]).tolist())
        if thing.type == "CURVES":
            radius = np.zeros(len(points))
            points.foreach_get("radius", radius)
            each["radius"] = [radius.min(), radius.max()]
        shader = data.materials[0].node_tree.nodes["Principled BSDF"].inputs["Base Color"]
        each["color"] = list(shader.default_value)[:3]
print("FOUND" + json.dumps(found))
"""


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """What Blender has of a file, imported by the page's lines."""
    if not BLENDER:
        pytest.skip("there is no bpy: pip install bpy, or WARP_YARN_BPY=/path/to/a/python/that/has/it")
    page = re.search(r"```python\n(import bpy\n.+?)```", PAGE.read_text(encoding="utf-8"), flags=re.S)[1]
    script = tmp_path_factory.mktemp("blender") / "look.py"
    script.write_text(page.replace('"out.usdc"', "__import__('sys').argv[1]") + LOOK)

    def found(path, frames):
        # of an empty scene, as Blender has its cube, lamp and camera
        empty = "import bpy, sys; bpy.ops.wm.read_factory_settings(use_empty=True)"
        start = f"{empty}; exec(open(sys.argv.pop(1)).read())"
        arguments = [BLENDER, "-c", start, str(script), str(path), json.dumps(frames)]
        done = subprocess.run(arguments, capture_output=True, text=True)
        assert done.returncode == 0 and "FOUND" in done.stdout, done.stderr
        return json.loads(done.stdout.split("FOUND")[1].splitlines()[0])

    return found


def expected(trajectory, frame):
    """Where the yarns are, their ends repeated, of each material; halfway between frames in the middle."""
    weaving, places = Weaving(trajectory.cloth), []
    for k in {int(np.floor(frame)), int(np.ceil(frame))}:
        look = weaving.look(trajectory.position[k])
        places.append([strands.points(*look)[strands.repeated] for strands in weaving.strands])
    return [np.mean(each, axis=0) for each in zip(*places, strict=True)]


def test_curves_have_their_radius_places_and_colours(tmp_path, imported):
    """A frame of 1 ms is a frame of Blender's at 1000/24 times slower; 3 mm from the origin and beyond, in metres."""
    trajectory = waving(frames=4)
    wy.write_usd(tmp_path / "a.usdc", trajectory, slowdown=1000.0 / 24.0)
    found = imported(tmp_path / "a.usdc", [0, 1, 2.5, 3])
    assert (found["scale"], found["end"], found["shapes"]) == (1.0, 3, ["THICK", "CYLINDER"])
    for at, frame in enumerate([0, 1, 2.5, 3]):
        for k, points in enumerate(expected(trajectory, frame)):
            assert found[f"yarn_{k}"]["type"] == "CURVES"
            # single precision of places up to 1/16 m
            np.testing.assert_allclose(found[f"yarn_{k}"]["position"][at], points, rtol=0, atol=8e-9)
    for k, color in enumerate((RED, BLUE)):
        np.testing.assert_allclose(found[f"yarn_{k}"]["radius"], 3e-4, rtol=1e-6)
        linear = [((c + 0.055) / 1.055) ** 2.4 for c in color]
        np.testing.assert_allclose(found[f"yarn_{k}"]["color"], linear, rtol=1e-5)


@pytest.mark.parametrize("slowdown", [20.0, 100.0])
def test_it_plays_as_slowly_as_it_says(tmp_path, imported, slowdown):
    """What Blender shows after a second of its frames was there after 1 s / slowdown."""
    trajectory = waving(frames=61)
    wy.write_usd(tmp_path / "a.usdc", trajectory, slowdown=slowdown)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    found = imported(tmp_path / "a.usdc", [24])
    assert found["fps"] == stage.GetTimeCodesPerSecond() == 24.0
    assert stage.GetRootLayer().customLayerData["slowdown"] == slowdown
    [points, _] = expected(trajectory, 1000.0 / slowdown)
    np.testing.assert_allclose(found["yarn_0"]["position"][0], points, rtol=0, atol=1e-8)


def test_tubes_and_packages(tmp_path, imported):
    """Meshes have their materials too, and .usdz is the same as .usdc."""
    trajectory = waving(frames=2)
    options = {"tubes": True, "surface": True, "slowdown": 1000.0 / 24.0}
    for ending in ("usdc", "usdz"):
        wy.write_usd(tmp_path / f"a.{ending}", trajectory, **options)
    found, packed = (imported(tmp_path / f"a.{ending}", [1]) for ending in ("usdc", "usdz"))
    assert found == packed
    assert {found[name]["type"] for name in ("yarn_0", "yarn_1", "surface")} == {"MESH"}
    np.testing.assert_allclose(found["surface"]["position"][0], trajectory.position[1], rtol=0, atol=8e-9)
    red, green, blue = found["yarn_0"]["color"]
    assert red > 3.0 * max(green, blue)
