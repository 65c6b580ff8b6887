"""The task of the box, as a Gymnasium environment, and the gradient of its return."""

import copy
import hashlib
import resource
import subprocess
import sys
import warnings

import gymnasium
import gymnasium.utils.env_checker
import numpy as np
import pytest
import torch

import warp_yarn as wy
from warp_yarn.envs import NAME, ThrowIntoBox, box
from warp_yarn.envs.picture import TOP, YARN

MADE = f"warp_yarn.envs:{NAME}"
NODES = 25
MIDDLE = {"shift": (0.0, 0.0), "turn": 0.0, "place": box.PLACE}


def toward(x: float, z: float) -> np.ndarray:
    """The same force on all corners in all steps, along x and up."""
    return np.tile([x, 0.0, z], (box.PUSHED, 4)).astype(np.float32)


THROWS = {
    "into": toward(0.5, 0.6),
    "too far": toward(1.0, 1.0),
    "too short": toward(0.2, 0.5),
    "not at all": toward(0, 0),
}


@pytest.fixture(scope="module")
def env():
    return ThrowIntoBox(render_mode="rgb_array")


def throw(env, actions, **options):
    """Makes an episode; gives its rewards and what the last step said."""
    env.reset(options=options or MIDDLE)
    made = [env.step(action) for action in actions]
    return [reward for _, reward, *_ in made], made[-1]


# -- the task ---------------------------------------------------------------------------------------------------------


def test_the_cloth_lies_still_where_it_starts(env):
    """But for its corners, which are lighter and come to lie 2 µm higher: an episode without forces is soon over."""
    rewards, (_, _, terminated, truncated, info) = throw(env, THROWS["not at all"])
    moved = env.trajectory.position - env.trajectory.position[0]
    assert np.abs(moved).max() < 3e-6
    assert terminated and not truncated and not info["is_success"]
    # all the way from the table's middle to the box's
    assert rewards[:-1] == [0.0] * (box.PUSHED - 1)
    assert rewards[-1] == pytest.approx(-np.linalg.norm(box.PLACE) / 20e-3, rel=1e-4)


@pytest.mark.parametrize("name", THROWS)
def test_a_throw_succeeds_where_all_of_it_ends_in_the_box(env, name):
    """Told again by the frames themselves."""
    _, (_, reward, terminated, _, info) = throw(env, THROWS[name])
    x, y, z = env.trajectory.position[-1].T
    within = (abs(x - 60e-3) < 20e-3) & (abs(y) < 20e-3) & (z < -10e-3)
    speed = np.linalg.norm(env.trajectory.velocity[-box.REST_STEPS :], axis=-1)
    assert terminated == (speed.max() < box.REST_SPEED)
    assert info["is_success"] == (name == "into") == bool(within.all() and terminated)
    # what flew far is outside of what the walls would stop: the reward is of where it came down
    assert info["distance"] == pytest.approx(-reward * 20e-3)


def test_a_throw_flies_as_a_point_does(env):
    """Up to where it comes down, the centre of mass follows implicit Euler's parabola, whose speed is that of a step's
    end; to what steps are solved to, which is far below a hundredth of g."""
    throw(env, THROWS["into"])
    t, k = env.trajectory, box.PUSHED + 1
    rows, columns = np.indices((5, 5))
    halves = [np.where((at == 0) | (at == 4), 0.5, 1.0) for at in (columns, rows)]
    density = np.array([yarn.density for yarn in env.cloth.yarns])[env.cloth.material]
    mass = (density[:5][rows] * halves[0] + density[5:][columns] * halves[1]).ravel()
    centre, velocity = ((mass @ frames) / mass.sum() for frames in (t.position, t.velocity))
    n = int(np.argmax(centre[:, 2] < box.ARRIVES)) - k
    time = n * box.STEP
    fall = 0.5 * 9.8 * time * (time + box.STEP)
    expected = centre[k] + velocity[k] * time - [0.0, 0.0, fall]
    assert n > 100
    assert np.linalg.norm(centre[k + n] - expected) < 1e-3 * np.linalg.norm(centre[k + n] - centre[k])


def test_nothing_comes_nearer_than_it_may(env):
    """To table, floor and walls, at every step, by formulas of a box; also where the throw hits walls."""
    radius = env.cloth.radius
    for name in ("into", "too short"):
        throw(env, THROWS[name])
        position = env.trajectory.position
        assert (position[..., 2] - box.BOTTOM).min() > radius
        for obstacle in (o for o in box.obstacles() if isinstance(o, wy.Box)):
            outside = np.maximum(np.abs(position - obstacle.position) - obstacle.size, 0.0)
            assert np.linalg.norm(outside, axis=-1).min() > radius


def test_arrival_is_where_a_path_comes_down_through_the_height():
    """Of a parabola, within what its curve departs from a chord over a step; of a path that stays above, its end."""
    t = np.linspace(0.0, 0.3, 301)
    path = np.stack([0.4 * t, 0.1 * t, 0.5 * t - 4.9 * t**2], axis=1)
    when = (0.5 + np.sqrt(0.25 - 4 * 4.9 * box.ARRIVES)) / 9.8
    expected = [0.4 * when, 0.1 * when, box.ARRIVES]
    assert np.abs(box.arrival(path) - expected).max() < 4.9 * 1e-3**2 / 4
    assert torch.equal(box.arrival(torch.tensor(path)), torch.tensor(box.arrival(path)))
    assert np.array_equal(box.arrival(path[:50]), path[49])


def test_success_asks_for_every_node_and_for_rest():
    position = np.tile(box.target() + np.array([0.0, 0.0, 1e-3]), (40, NODES, 1))
    velocity = np.zeros_like(position)
    assert box.success(position, velocity)
    for frame, changed in ((-1, False), (-20, False), (-21, True)):
        out, moving = position.copy(), velocity.copy()
        out[frame, 7, 1] = 21e-3
        moving[frame, 24, 2] = 0.011
        assert box.success(out, velocity) == changed
        assert box.success(position, moving) == changed
    above = position.copy()
    above[:, 3, 2] = -9e-3
    assert not box.success(above, velocity)
    assert not box.success(position, velocity, place=(85e-3, 0.0))


def test_wrong_arguments_of_the_task_are_refused():
    cloth = box.cloth()
    for call, message in (
        (lambda: box.scene(cloth, touches="walls"), "touches = 'walls', must be one of all, table, nothing"),
        (lambda: box.scene(cloth, np.zeros((5, 3, 3))), r"forces has shape \(5, 3, 3\), must be \(any, 4, 3\)"),
        (lambda: box.cloth(shift=(1.0,)), r"shift has shape \(1,\)"),
        (lambda: box.scene(cloth, place=(np.nan, 0.0)), r"place\[0\] is nan"),
        (lambda: ThrowIntoBox(render_mode="human"), "render_mode = 'human', must be one of rgb_array"),
        (lambda: ThrowIntoBox(friction=-1.0), "friction = -1.0, must be finite and at least 0"),
    ):
        with pytest.raises(wy.InputError, match=message):
            call()


# -- the environment --------------------------------------------------------------------------------------------------


def test_gymnasium_finds_nothing_wrong():
    env = gymnasium.make(MADE, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # it says of every environment from make() that it is wrapped
        gymnasium.utils.env_checker.check_env(env.unwrapped)


def test_stable_baselines_finds_nothing_wrong(env):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)


@pytest.mark.parametrize("mode", ["sync", pytest.param("async", marks=pytest.mark.slow)])
def test_gymnasium_makes_several_side_by_side(mode):
    """Each as one alone with its seed, in processes of their own too."""
    apart = {"vector_kwargs": {"context": "spawn"}} if mode == "async" else {}
    several = gymnasium.make_vec(MADE, num_envs=2, vectorization_mode=mode, **apart)
    seen, _ = several.reset(seed=[3, 4])
    for _ in range(box.PUSHED):
        seen, reward, terminated, truncated, _ = several.step(np.tile(THROWS["into"][0], (2, 1)))
    assert (terminated | truncated).all() and (reward < 0.0).all()
    alone = ThrowIntoBox()
    for k in range(2):
        alone.reset(seed=3 + k)
        made = [alone.step(action) for action in THROWS["into"]]
        assert made[-1][1] == reward[k]
        assert np.array_equal(made[-1][0], seen[k])
    several.close()


def random_rollout(env, steps, seed):
    """Actions at random, and resets too, before episodes are over; a digest of all that it was told."""
    rng, told, over = np.random.default_rng(seed), hashlib.sha256(), True
    env.reset(seed=seed)
    for _ in range(steps):
        if over or rng.random() < 0.1:
            told.update(env.reset()[0].tobytes())
        seen, reward, terminated, truncated, info = env.step(rng.uniform(-1.2, 1.2, 12).astype(np.float32))
        assert np.isfinite(seen).all() and np.isfinite(reward)
        told.update(seen.tobytes())
        told.update(repr((reward, terminated, truncated, info)).encode())
        over = terminated or truncated
    return told.hexdigest()


@pytest.mark.parametrize("steps", [60, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_random_rollout_repeats_and_leaks_nothing(env, steps):
    """Bit for bit, in another environment and in one that has done other things. What the process may grow by is what
    the allocator does not give back: far less than 1 kB for each of some 2400 episodes, whose frames take 0.3 MB."""
    other = ThrowIntoBox()
    short = random_rollout(other, 60, seed=7)
    assert random_rollout(env, 60, seed=8) != short
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    expected = random_rollout(other, steps, seed=7)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert random_rollout(env, steps, seed=7) == expected
    assert grown < 2_000


def test_starts_and_boxes_are_at_random_within_what_is_said(env):
    env.reset(seed=1)
    starts = []
    for _ in range(200):
        seen, _ = env.reset()
        assert env.observation_space.contains(seen)
        grid = seen[: 3 * NODES].reshape(5, 5, 3)
        along = grid[0, -1] - grid[0, 0]
        starts.append([*grid.mean(axis=(0, 1))[:2], np.arctan2(along[1], along[0]), *seen[-3:-1]])
    low, high = np.min(starts, axis=0), np.max(starts, axis=0)
    bounds = np.array([[-5e-3, -5e-3, -np.pi / 4, 50e-3, -20e-3], [5e-3, 5e-3, np.pi / 4, 70e-3, 20e-3]])
    # of 200 the outermost are as near as this, but once in e^10 = 22,000 each
    assert (low >= bounds[0] - 1e-7).all() and (low < bounds[0] + 0.05 * (bounds[1] - bounds[0])).all()
    assert (high <= bounds[1] + 1e-7).all() and (high > bounds[1] - 0.05 * (bounds[1] - bounds[0])).all()
    still = ThrowIntoBox(random=False)
    assert np.array_equal(still.reset(seed=1)[0], still.reset(seed=2)[0])
    assert np.array_equal(still.reset()[0][-3:-1], np.float32(box.PLACE))


def test_what_is_given_changes_nothing_of_the_others(env):
    env.reset(seed=5)
    drawn = env.shift, env.turn, env.place
    env.reset(seed=5, options={"turn": 0.3})
    assert np.array_equal(env.shift, drawn[0]) and env.turn == 0.3 and np.array_equal(env.place, drawn[2])


def test_bad_actions_are_refused_and_large_ones_clipped(env):
    env.reset(seed=1, options=MIDDLE)
    for action, message in (
        (np.full(12, np.nan), "action.*nan, must be finite"),
        (np.zeros(11), r"action has shape \(11,\), must be \(12\)"),
        (np.zeros((4, 3)), r"action has shape \(4, 3\)"),
        (["a"] * 12, "action must be an array of numbers"),
    ):
        with pytest.raises(wy.InputError, match=message):
            env.step(action)
    # refused ones count as none
    large, _ = throw(env, 3.0 * THROWS["too far"])
    assert large == throw(env, THROWS["too far"])[0]


def test_a_copy_goes_on_by_itself(env):
    """In the midst of an episode, with the box where that one has it."""
    env.reset(options={**MIDDLE, "place": (65e-3, 5e-3)})
    env.step(THROWS["into"][0])
    other = copy.deepcopy(env)
    expected = [env.step(action)[1] for action in THROWS["into"][1:]]
    assert [other.step(action)[1] for action in THROWS["into"][1:]] == expected


def test_steps_need_an_episode():
    env = ThrowIntoBox()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(THROWS["into"][0])
    for call in (lambda: env.trajectory, lambda: env.differentiable(torch.zeros(box.PUSHED, 12))):
        with pytest.raises(wy.InputError, match="call reset"):
            call()
    throw(env, THROWS["not at all"])
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(THROWS["into"][0])
    for options, message in (
        ({"box": 1}, "must be one of shift, turn, place"),
        ({"place": (0.0, 0.0, 0.0)}, r"place has shape \(3,\)"),
        ({"place": (41e-3, 51e-3)}, r"place = \(0.041, 0.051\), must have .* beside the table"),
        ({"turn": "a"}, "turn = 'a', must be a number"),
    ):
        with pytest.raises(wy.InputError, match=message):
            env.reset(options=options)
    env.reset(options=MIDDLE)
    assert env.step(THROWS["into"][0])[1] == 0.0


def test_a_step_that_cannot_be_made_ends_the_episode(env, monkeypatch):
    env.reset(options=MIDDLE)
    env.step(THROWS["into"][0])
    frames = env.trajectory

    def fails(steps):
        raise wy.SimulationError("stopped", step=1, node=-1, term=None, trajectory=frames.cut(1))

    monkeypatch.setattr(env.simulator, "run", fails)
    seen, reward, terminated, truncated, info = env.step(THROWS["into"][1])
    assert (terminated, truncated, info["failed"], info["is_success"]) == (False, True, "stopped", False)
    assert reward < 0.0 and env.observation_space.contains(seen)
    monkeypatch.undo()
    assert throw(env, THROWS["into"])[1][4]["is_success"]


def test_what_does_not_come_to_rest_in_time_is_truncated(env, monkeypatch):
    monkeypatch.setattr(box, "STEPS", 100)
    _, (_, reward, terminated, truncated, info) = throw(env, THROWS["into"])
    assert (terminated, truncated, info["is_success"]) == (False, True, False)
    assert len(env.trajectory) == 101 and reward < 0.0


def test_the_picture_shows_where_the_cloth_and_the_box_are(env):
    """Of the yarns in the view from above the middle, by its scale."""
    for place in ((50e-3, -20e-3), (70e-3, 20e-3)):
        env.reset(options={**MIDDLE, "place": place, "shift": (4e-3, -3e-3)})
        above = env.render()[-TOP:]
        row, column = np.argwhere((above == YARN).all(axis=-1)).mean(axis=0)
        assert abs((column + 0.5) / 2000.0 - 40e-3 - 4e-3) < 1e-3
        assert abs(0.5 * TOP / 2000.0 - (row + 0.5) / 2000.0 + 3e-3) < 1e-3
        walls = np.argwhere((above == (110, 120, 140)).all(axis=-1)).mean(axis=0)
        assert np.abs((walls[1] + 0.5) / 2000.0 - 40e-3 - place[0]) < 1e-3
        assert np.abs(0.5 * TOP / 2000.0 - (walls[0] + 0.5) / 2000.0 - place[1]) < 1e-3
    assert ThrowIntoBox().render() is None


def test_the_frames_of_an_episode_can_be_written(env, tmp_path):
    throw(env, THROWS["into"], **{**MIDDLE, "place": (55e-3, 1e-3), "turn": 0.2})
    trajectory = env.trajectory
    simulator = wy.Simulator(trajectory.scene, step=box.STEP, integrator=box.INTEGRATOR)
    again = simulator.run(len(trajectory) - 1)
    # a cloth's origin is its own middle, which rounds otherwise; a landing multiplies that
    assert np.abs(again.position - trajectory.position)[:100].max() < 1e-9
    assert np.array_equal(trajectory.scene.obstacles[2].position, box.walls((55e-3, 1e-3))[0])
    wy.write_usd(tmp_path / "throw.usdc", trajectory)
    assert (tmp_path / "throw.usdc").stat().st_size > 0


def test_gymnasium_is_asked_for_by_name_where_it_is_missing():
    """In a process without it; the task itself needs none."""
    program = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "import importlib.util, importlib.machinery\n"
        "found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: None if name == 'gymnasium' else found(name, *a)\n"
        "from warp_yarn import envs\n"
        "from warp_yarn.envs import box\n"
        "box.scene(box.cloth())\n"
        "envs.ThrowIntoBox\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "gymnasium is not installed, which environments need: pip install" in done.stderr


# -- the gradient -----------------------------------------------------------------------------------------------------


def test_the_return_is_that_of_the_episode(env):
    """To the tolerance of the episode's steps, which is 2e-2 of a change of velocity or less, and in the end some 1e-3
    of the way."""
    for name in ("into", "too far"):
        rewards, _ = throw(env, THROWS[name])
        assert env.differentiable(torch.tensor(THROWS[name])).item() == pytest.approx(sum(rewards), rel=2e-2)


@pytest.mark.parametrize("touches", ["all", pytest.param("nothing", marks=pytest.mark.slow)])
def test_the_gradient_is_that_of_differences(env, touches):
    """Through the table's friction and the flight; of pushes that turn the cloth, one corner dragging on the table."""
    env.reset(options={"shift": (1e-3, 2e-3), "turn": 0.4, "place": (55e-3, 10e-3)})
    rng = np.random.default_rng(2)
    actions = torch.tensor(0.5 * THROWS["into"] + 0.2 * rng.uniform(-1, 1, (box.PUSHED, 12)) + toward(0.2, 0.3))
    actions.requires_grad_()
    env.differentiable(actions, touches=touches).backward()
    for _ in range(2):
        direction = torch.tensor(rng.normal(size=(box.PUSHED, 12)))
        e = 1e-4
        with torch.no_grad():
            ahead, behind = (env.differentiable(actions + s * e * direction, touches=touches) for s in (1, -1))
        # what is left of steps is 1e-8, over 2e-4; curvature 1e-8
        assert float((actions.grad * direction).sum()) == pytest.approx(float(ahead - behind) / (2 * e), rel=1e-3)


def test_asking_for_gradients_leaves_the_episode_as_it_is(env):
    expected, _ = throw(env, THROWS["into"])
    env.reset(options=MIDDLE)
    rewards = []
    for action in THROWS["into"]:
        env.differentiable(torch.tensor(THROWS["too far"]))
        rewards.append(env.step(action)[1])
    assert rewards == expected
    for actions in (torch.zeros(12), torch.full((box.PUSHED, 12), torch.nan)):
        with pytest.raises(wy.InputError, match=r"actions of shape .*must be finite and of shape \(5, 12\)"):
            env.differentiable(actions)
    beyond = torch.full((box.PUSHED, 12), 1.5, requires_grad=True)
    env.differentiable(beyond).backward()
    assert not beyond.grad.any()
