"""Weaves in words, as drawdowns, and which way up they are: in weavers' drawings and in the cloth."""

import itertools
import struct
import zlib

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.description.notation import repeat
from warp_yarn.view.yarns import Weaving

WEAVES = {
    # as textbooks draw them: the first pick at the bottom, # where the warp is on top
    "plain": ".# #.",
    "1/1 twill": ".# #.",
    "2/2 twill": "#..# ..## .##. ##..",
    "2/2 twill S": ".##. ..## #..# ##..",
    "2/1 twill": "#.# .## ##.",
    "1/3 twill": "...# ..#. .#.. #...",
    "3/1 twill S": ".### #.## ##.# ###.",
    "3/1/1/2 twill Z": "##.#..# #.#..## .#..### #..###. ..###.# .###.#. ###.#..",
    "satin 5/2": "##.## ####. #.### ###.# .####",
    "satin 5/3": "###.# #.### ####. ##.## .####",
    "sateen 5/2": "..#.. ....# .#... ...#. #....",
    "warp rib 2/2": ".# .# #. #.",
    "warp rib 3/1": ".# #. #. #.",
    "weft rib 2/2": "..## ##..",
    "panama 2/2": "..## ..## ##.. ##..",
    "panama 2/1": "..# ##. ##.",
    "2/2 herringbone 4": "#..#.##. ..##..## .##.#..# ##..##..",
}
SAME = {
    "Twill 2/2": "2/2 twill",
    " 2 / 2   Z twill ": "2/2 twill",
    "2/2 twill weave Z": "2/2 twill",
    "tabby": "plain",
    "plain weave": "plain",
    "5/2 SATIN": "satin 5/2",
    "warp satin 5/2": "satin 5/2",
    "weft satin 5/2": "sateen 5/2",
    "2/2 warp rib": "warp rib 2/2",
    "2/2 matt": "panama 2/2",
    "hopsack 2/2": "panama 2/2",
    "basket weave 2/2": "panama 2/2",
    "2/2 herringbone": "2/2 herringbone 8",
    "herringbone S 2/2": "2/2 herringbone S 8",
}


def drawn(text: str) -> np.ndarray:
    """A drawdown [picks, ends] of lines, of which the last is the first pick."""
    return np.array([[square == "#" for square in line] for line in text.split()])[::-1]


@pytest.mark.parametrize("words", WEAVES)
def test_words_are_the_weaves_of_textbooks(words):
    np.testing.assert_array_equal(repeat(words), drawn(WEAVES[words]))


@pytest.mark.parametrize("words", SAME)
def test_words_for_the_same(words):
    np.testing.assert_array_equal(repeat(words), repeat(SAME[words]))


def test_sides_and_mirrors():
    """The other side of a satin, turned over about its ends, is the sateen that rises the other way."""
    other = ~repeat("satin 8/3")[:, ::-1]
    assert any(np.array_equal(np.roll(other, shift, axis=1), repeat("sateen 8/5")) for shift in range(8))
    for figures in ("2/2", "3/1", "1/2/3/1"):
        z, s = repeat(f"{figures} twill Z"), repeat(f"{figures} twill S")
        np.testing.assert_array_equal(z[0], s[0])
        for up, down in itertools.pairwise(z):
            np.testing.assert_array_equal(down, np.roll(up, 1))
        for up, down in itertools.pairwise(s):
            np.testing.assert_array_equal(down, np.roll(up, -1))


@pytest.mark.parametrize("words", ["2/2 herringbone", "3/3 herringbone 5", "2/2 herringbone S 6"])
def test_herringbones_turn_where_ends_are_opposite(words):
    weave = repeat(words)
    half = weave.shape[1] // 2
    np.testing.assert_array_equal(weave[:, half - 1], ~weave[:, half])
    np.testing.assert_array_equal(weave[:, -1], ~weave[:, 0])
    rise = -1 if "S" in words else 1
    for end in range(half - 1):
        np.testing.assert_array_equal(weave[:, end + 1], np.roll(weave[:, end], rise))
        np.testing.assert_array_equal(weave[:, half + end + 1], np.roll(weave[:, half + end], -rise))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("twill", r"weave = 'twill', must be words such as"),
        ("2/2", "must be words such as"),
        ("knit 2/2", "must be words such as"),
        ("2/2 3/1 twill", "must be words such as"),
        ("2/2 twill 7", "must be words such as"),
        ("2/2 twill Q", "must be words such as"),
        ("satin 5/2 Z", "must be words such as"),
        ("plain 1/1", "must be words such as"),
        ("rib 2/2", "must be words such as"),
        ("", "must be words such as"),
        (5, "weave = 5, must be words"),
        (None, "weave = None, must be words"),
        ("2/2/1 twill", "an even number of them"),
        ("0/2 twill", "at least 1, and 1000 at most"),
        ("999/2 twill", "at least 1, and 1000 at most"),
        ("9999999999999/1 twill", "at least 1, and 1000 at most"),
        ("satin 6/2", "no satin of 6 ends: must be 5, or 7"),
        ("satin 4/2", "no satin of 4 ends"),
        ("satin 8/2", "the step of 8 ends must be one of 3, 5"),
        ("satin 5/1", "must be one of 2, 3"),
        ("satin 5/4", "must be one of 2, 3"),
        ("satin 5/2/1", "ends and step"),
        ("2/1 herringbone", "floats over and under must be the same"),
        ("2/2 herringbone 1", "after 2 to 1000 ends"),
        ("2/2 herringbone 1001", "after 2 to 1000 ends"),
    ],
)
def test_other_words_are_told(words, told):
    with pytest.raises(wy.InputError, match=told):
        wy.Weave.from_notation(words, rows=5, columns=5)


# -- which way up ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", ["3/1 twill Z", "satin 5/2", "2/1 twill S", "weft rib 2/1"])
def test_a_weave_is_repeated_and_cut(words):
    weave, small = wy.Weave.from_notation(words, rows=9, columns=7), repeat(words)
    assert (weave.rows, weave.columns, weave.name) == (9, 7, words)
    assert weave.warp_on_top.shape == (7, 9)
    for pick in range(7):
        for end in range(9):
            assert weave.warp_on_top[pick, end] == small[pick % len(small), end % small.shape[1]]
            inside = 0 < pick < 6 and 0 < end < 8
            assert weave.flipped[8 - end, pick] == (inside and weave.warp_on_top[pick, end])
    again = wy.Weave.from_drawdown(weave.warp_on_top)
    np.testing.assert_array_equal(again.draft, weave.draft)


@pytest.mark.parametrize(("pose", "toward"), [("flat", (0.0, 0.0, 1.0)), ("upright", (0.0, 1.0, 0.0))])
@pytest.mark.parametrize("words", ["3/1 twill Z", "1/3 twill Z", "2/2 twill S", "satin 5/2"])
def test_the_face_of_the_cloth_is_what_is_drawn(words, pose, toward):
    """By where the yarns pass that are drawn in pictures, which is where contact presses them."""
    weave = wy.Weave.from_notation(words, rows=9, columns=8)
    yarns = [wy.Yarn(density=1e-3, stretch=1e5, bend=1e-4)] * 2
    cloth = wy.Cloth(weave, yarns=yarns, warp=[0] * 9, weft=[1] * 8, pose=pose)
    weaving = Weaving(cloth)
    look = weaving.look(cloth.position)
    warp, weft = ({k: x for k, x in zip(part.places, part.points(*look), strict=True)} for part in weaving.strands)
    up = np.array([1.0, 0.0, 0.0])  # weft yarns count along x
    right = np.cross(up, toward)
    ends, picks = (np.array([of[node] for node in range(72)]).reshape(9, 8, 3) for of in (warp, weft))
    # seen from the face: sorted by how far right the warp yarns are, and how far up the weft yarns
    across, along = np.argsort(ends[:, 4] @ right), np.argsort(picks[4] @ up)
    over = ((ends - picks) @ toward > 0.0)[np.ix_(across, along)].T
    np.testing.assert_array_equal(over, np.tile(repeat(words), (3, 3))[:8, :9])


def pixels(path) -> np.ndarray:
    """Of a PNG file of this kind [height, width, 3]."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, {}
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind], at = body, at + 12 + length
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(height, 1 + 3 * width)
    assert not lines[:, 0].any()
    return lines[:, 1:].reshape(height, width, 3)


def test_a_twill_z_rises_to_the_right_in_the_picture(tmp_path):
    path = tmp_path / "draft.png"
    wy.Weave.from_notation("2/2 twill Z", rows=9, columns=6).drawdown(path)
    seen = pixels(path)
    assert seen.shape == (6 * 20 + 1, 9 * 20 + 1, 3)
    squares = seen[10::20, 10::20].mean(axis=2)[::-1]  # the first pick first
    assert (squares[0] == 225).all() and (squares[:, -1] == 225).all()
    dark = squares[1:-1, 1:-1] < 128
    np.testing.assert_array_equal(dark, np.tile(repeat("2/2 twill"), (2, 3))[1:5, 1:8])
    for pick in range(3):
        np.testing.assert_array_equal(dark[pick + 1, 1:], dark[pick, :-1])


def test_pictures_of_drafts_have_their_threading_and_colours(tmp_path):
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    draft = wy.Draft(
        threading=[[1], [2], [3]],
        treadling=[[1], [2]],
        tieup=[[1], [2, 3]],
        warp_colors=colors,
        weft_colors=colors[:2] / 5,
    )
    path = tmp_path / "draft.png"
    wy.write_drawdown(path, draft, square=1)
    red, green, blue, wine, moss = [255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 0, 0], [0, 51, 0]
    o, x = [255, 255, 255], [20, 20, 20]
    expected = [
        # warp colours; threading from the third shaft, and tie-up; the second pick; the first pick; weft colours
        [red, green, blue, o, o, o, o, o],
        [o, o, o, o, o, o, o, o],
        [o, o, x, o, o, x, o, o],
        [o, x, o, o, o, x, o, o],
        [x, o, o, o, x, o, o, o],
        [o, o, o, o, o, o, o, o],
        [moss, green, blue, o, o, x, o, moss],
        [red, wine, wine, o, x, o, o, wine],
    ]
    np.testing.assert_array_equal(pixels(path), expected)
    wy.write_drawdown(path, wy.Draft(threading=[[1], [2]], treadling=[[2], [1]]), square=1)
    expected = [[o, x, o, o, o], [x, o, o, o, o], [o, o, o, o, o], [x, o, o, x, o], [o, x, o, o, x]]
    np.testing.assert_array_equal(pixels(path), expected)


def test_pictures_of_nothing_and_of_too_much(tmp_path):
    weave = wy.Weave.plain(rows=4, columns=4)
    with pytest.raises(wy.InputError, match=r"must end in \.png"):
        weave.drawdown(tmp_path / "draft.jpg")
    with pytest.raises(wy.InputError, match="must be a Draft or a Weave"):
        wy.write_drawdown(tmp_path / "draft.png", weave.flipped)
    for square in (0, 65, 1.5):
        with pytest.raises(wy.InputError, match=r"square = .* from 1 to 64"):
            wy.write_drawdown(tmp_path / "draft.png", weave, square=square)
    with pytest.raises(wy.InputError, match="must be at most 25000000 pixels"):
        wy.write_drawdown(tmp_path / "draft.png", wy.Weave.plain(rows=1000, columns=1000), square=6)
    assert not list(tmp_path.iterdir())
    wy.write_drawdown(tmp_path / "draft.png", wy.Weave.plain(rows=1000, columns=30))
    assert pixels(tmp_path / "draft.png").shape == (30, 1000, 3)


@pytest.mark.parametrize("array", [[], [0, 1, 0], [[[0]]], [[0, 1], [0]], [[0, 2], [1, 0]], [["#"]]])
def test_what_is_no_drawdown(array):
    with pytest.raises(wy.InputError, match="two-dimensional array of 0 and 1"):
        wy.Weave.from_drawdown(array, rows=4, columns=4)


@pytest.mark.parametrize("fabric", wy.fabrics.FABRICS)
def test_fabrics_take_words_and_weaves(fabric):
    make = wy.fabrics.FABRICS[fabric]
    weave = wy.Weave.from_notation("3/1 twill", rows=5, columns=6)
    for given in ("3/1 twill", weave):
        np.testing.assert_array_equal(make(weave=given, rows=5, columns=6).weave.flipped, weave.flipped)
    assert make(weave="twill", rows=5, columns=6).weave.name == "twill"  # the paper's
    with pytest.raises(wy.InputError, match=r"rows = 4, columns = 6 must be the same"):
        make(weave=weave, rows=4, columns=6)
    with pytest.raises(wy.InputError, match="weave = 'twill 2', must be words"):
        make(weave="twill 2", rows=4, columns=6)
