"""Weavers' drafts: what real programs write is read, what is malformed told, and what is written is read the same."""

import codecs
import importlib.util
import os
import random
import time
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.io import draft as reader

OWN = Path(__file__).parent / "data" / "drafts"
"""Small files of ours, each with the quirks of one program."""

ELSEWHERE = os.environ.get("WARP_YARN_DRAFTS", "")
"""A folder with drafts of others, such as of public repositories, which are not ours to keep."""

ZIGZAG = np.array([[up == "#" for up in row] for row in ["##..##", ".##..#", "..##..", "#..##.", "..##.."]])
"""The drawdown of all of our files: a 2/2 twill Z that turns back in its last pick; the first pick first."""


def quiet(path, **options) -> wy.Draft:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return wy.read_draft(path, **options)


@pytest.fixture
def written(tmp_path):
    """Writes a file and gives its path."""

    def write(text: str | bytes, name: str = "draft.wif") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


# -- files of real programs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(OWN.glob("*.wif")), ids=lambda path: path.stem)
def test_the_drawdown_of_every_program(path):
    draft = quiet(path)
    np.testing.assert_array_equal(draft.warp_on_top, ZIGZAG)
    assert (draft.ends, draft.picks, draft.rising) == (6, 5, path.stem != "sinking")
    np.testing.assert_array_equal(draft.weave.warp_on_top[1:-1, 1:-1], ZIGZAG[1:-1, 1:-1])
    assert (draft.weave.rows, draft.weave.columns, draft.weave.name) == (6, 5, draft.name)


NAMES = {
    "fiberworks": "zigzag.dtx; 100 % wool",
    "tempoweave": "tempoweave",
    "dbweave": r"C:\drafts\zigzag.dbw",
    "weavepoint": "zigzag.wpo",
    "weaveit": "weaveit",
    "minimum": "minimum",
}
CENTIMETRES = {"fiberworks": ([0.212] * 6, [0.212] * 5), "tempoweave": ([0.212, 0.424] + [0.212] * 4, [0.212] * 5)}
INCHES = {
    "weavepoint": ([0.2] * 6, [0.2] * 5),
    "weaveit": ([0.04167] * 6, [0.04167] * 5),
    "pixeloom": ([0.05] * 6, [0.1] * 5),  # 36 and 72 of 720
}
WHITE, OCHRE, BLUE = (1.0, 1.0, 1.0), (1.0, 532 / 999, 0.0), (0.0, 0.0, 599 / 999)
STEEL, PLUM = (35 / 200, 97 / 200, 158 / 200), (105 / 200, 40 / 200, 67 / 200)  # from 20 to 220
COLORS = {
    "fiberworks": ([WHITE] + [OCHRE] * 5, [WHITE, BLUE, WHITE, BLUE, WHITE]),
    "tempoweave": ([(1.0, 1.0, 0.8)] * 6, [(85 / 255, 107 / 255, 47 / 255)] * 5),
    "dbweave": ([(5 / 255, 10 / 255, 243 / 255)] * 6, [(0.0, 0.0, 1.0)] * 5),
    "weavepoint": ([WHITE, (1.0, 0.0, 0.0)] + [WHITE] * 4, [(1.0, 0.0, 0.0)] * 5),
    "weaveit": ([STEEL] * 6, [PLUM, PLUM, STEEL, PLUM, PLUM]),
    "pixeloom": ([(1.0, 0.0, 0.0)] * 6, [(0.0, 1.0, 0.0)] * 5),
}


@pytest.mark.parametrize("program", [path.stem for path in sorted(OWN.glob("*.wif"))])
def test_names_lengths_and_colours_of_every_program(program):
    draft = quiet(OWN / f"{program}.wif")
    assert draft.name == NAMES.get(program, "zigzag")
    lengths = CENTIMETRES.get(program) or INCHES.get(program)
    for values, expected in zip((draft.warp_spacing, draft.weft_spacing), lengths or (None, None), strict=True):
        if expected is None:
            assert values is None
        else:
            unit = 0.01 if program in CENTIMETRES else 0.0254
            np.testing.assert_allclose(values, unit * np.array(expected), rtol=1e-15)  # of one rounding
    if program in COLORS:
        np.testing.assert_array_equal(draft.warp_colors, COLORS[program][0])
        np.testing.assert_array_equal(draft.weft_colors, COLORS[program][1])
    assert (draft.warp_thickness is None) == (program not in ("fiberworks", "tempoweave", "weaveit"))
    assert (draft.weft_thickness is None) == (program not in ("fiberworks", "weaveit"))
    assert (draft.tieup is None) == (program in ("tempoweave", "minimum"))


def test_what_is_left_out_or_taken_for_granted_is_a_warning():
    with pytest.warns(UserWarning) as told:
        wy.read_draft(OWN / "weavepoint.wif")
    assert [str(each.message).partition("weavepoint.wif: ")[2] for each in told] == [
        "[WARP] Threads = 1200, of which [THREADING] uses 6: the rest is left out",
        "[WEFT] Threads = 1200, of which [TREADLING] uses 5: the rest is left out",
    ]
    with pytest.warns(UserWarning, match=r"minimum\.wif: \[WEAVING\] Rising Shed is missing: taken as true"):
        wy.read_draft(OWN / "minimum.wif")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wy.read_draft(OWN / "minimum.wif", rising=True)
        wy.read_draft(OWN / "fiberworks.wif")


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("[WEAVING]\nShafts=2", r"\[WEAVING\] Shafts = 2, but shaft 4 is used: taken as 4"),
        ("[WARP]\nSpacing=1", r"\[WARP\] Units is missing: Spacing is left out"),
        (
            "[WEFT]\nUnits=Inches\n[WEFT THICKNESS]\n2=1",
            r"Thickness is missing, and \[WEFT THICKNESS\] has none",
        ),
        ("[WEAVING]\nRising Shed=", r"Rising Shed is missing"),
    ],
)
def test_other_warnings(written, lines, told):
    path = written((OWN / "minimum.wif").read_text() + lines)
    with pytest.warns(UserWarning, match=told):
        draft = wy.read_draft(path, rising=None if "Rising" in told else True)
    np.testing.assert_array_equal(draft.warp_on_top, ZIGZAG)
    assert draft.warp_spacing is None and draft.weft_thickness is None


@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.parametrize("program", ["sinking", "fiberworks", "minimum"])
def test_shafts_that_sink_leave_the_others_up(program, rising):
    """A shaft that rises lifts its ends over the pick; one that sinks takes them under it, and the rest are over."""
    drawn = quiet(OWN / f"{program}.wif", rising=rising).warp_on_top
    as_drawn = rising != (program == "sinking")
    np.testing.assert_array_equal(drawn, ZIGZAG if as_drawn else ~ZIGZAG)


BASE = (OWN / "fiberworks.wif").read_bytes().decode()


@pytest.mark.parametrize(
    "data",
    [
        codecs.BOM_UTF8 + BASE.encode(),
        BASE.replace("wool", "Wölle").encode("latin-1"),
        BASE.replace("wool", "Wölle \u2028").encode("utf-8"),
        BASE.replace("wool", "wool\x85").encode("latin-1"),  # which Python takes for the end of a line
        BASE.encode("utf-16"),
        BASE.replace("\r\n", "\n").encode(),
        BASE.replace("\r\n", "\r").encode(),
        BASE.upper().encode(),
        BASE.replace("=", " =  ").encode(),
        BASE.replace("[", "[ ").replace("]", " ] ").encode(),
        BASE.replace("1=1,2\r", "1=1,2 ; the first\r").encode(),
        BASE.replace("Rising Shed=true", "Rising Shed=ON").encode(),
    ],
    ids=[
        "BOM",
        "Latin-1",
        "UTF-8",
        "Latin-1 control",
        "UTF-16",
        "LF",
        "CR",
        "capitals",
        "spaces",
        "brackets",
        "comment",
        "on",
    ],
)
def test_however_it_is_written(written, data):
    draft, expected = quiet(written(data)), quiet(OWN / "fiberworks.wif")
    assert draft.threading == expected.threading and draft.tieup == expected.tieup
    np.testing.assert_array_equal(draft.warp_on_top, ZIGZAG)
    np.testing.assert_array_equal(draft.weft_colors, expected.weft_colors)
    np.testing.assert_array_equal(draft.warp_spacing, expected.warp_spacing)
    assert draft.name.lower().startswith("zigzag.dtx; 100 % w") and "\n" not in draft.name


# -- malformed files ---------------------------------------------------------------------------------------------------

MALFORMED = {
    # replaced, by what, told
    "no WIF": ("[WIF]", "[WAF]", r"has no section \[WIF\]"),
    "bracket": ("[TIEUP]", "[TIEUP", r"line \d+: '\[TIEUP' has no \]"),
    "no =": ("Shafts=4", "Shafts 4", r"\[WEAVING\] 'Shafts 4' has no ="),
    "twice": ("3=3\r\n4=4\r\n5=1", "3=3\r\n3=4\r\n5=1", r"\[THREADING\] 3 is there twice, as '3' and as '4'"),
    "twice, 0": ("3=3\r\n4=4\r\n5=1", "3=3\r\n03=4\r\n5=1", r"\[THREADING\] 3 is there twice, as '3' and as '4'"),
    "thread 0": ("[WARP SPACING]", "[WARP SPACING]\r\n0=1", r"\[WARP SPACING\] key = '0', must be .* from 1"),
    "no threading": ("[THREADING]", "[PRIVATE]", r"\[THREADING\] is missing or empty"),
    "no tie-up": ("[TIEUP]", "[PRIVATE]", r"\[TIEUP\] is missing or empty, which \[TREADLING\] needs"),
    "no treadling": ("[TREADLING]", "[PRIVATE]", r"\[TREADLING\] is missing or empty, which \[TIEUP\] needs"),
    "shaft": ("5=1\r\n6=2\r\n\r\n[TIEUP]", "5=x\r\n[TIEUP]", r"\[THREADING\] 5 = 'x', must be a whole number from 0"),
    "negative": ("3=3,4", "3=-3,4", r"\[TIEUP\] 3 = '-3', must be a whole number from 0 to 10000"),
    "part": ("3=3,4", "3=3.5", r"\[TIEUP\] 3 = '3\.5', must be a whole number"),
    "digits": ("3=3,4", "3=٣", r"\[TIEUP\] 3 = '٣', must be a whole number"),
    "key": ("3=3,4", "c=3,4", r"\[TIEUP\] key = 'C', must be a whole number from 1"),
    "negative key": ("3=3,4", "-3=3,4", r"\[TIEUP\] key = '-3', must be a whole number from 1"),
    "bare": ("3=3,4", "third 3,4", r"\[TIEUP\] key = 'THIRD 3,4', must be a whole number"),
    "treadle": (
        "5=3\r\n",
        "5=7\r\n",
        r"\[TREADLING\] 5 = '7', must be a whole number from 0 to 6 \(the last",
    ),
    "pick": ("5=3\r\n", "6=3\r\n", r"\[TREADLING\] 6 must be at most 5 \(\[WEFT\] Threads\)"),
    "end": ("6=2\r\n\r\n[TIEUP]", "7=2\r\n[TIEUP]", r"\[THREADING\] 7 must be at most 6 \(\[WARP\] Threads\)"),
    "threads": ("Threads=6", "Threads=1000000000", r"\[WARP\] Threads = '1000000000', must be .* from 0 to 10000"),
    "endless": ("Threads=6", "Threads=" + "9" * 5000, r"\[WARP\] Threads = '9{40}', must be"),
    "shafts": ("Shafts=4", "Shafts=-4", r"\[WEAVING\] Shafts = '-4', must be"),
    "treadles": ("Treadles=4", "Treadles=four", r"\[WEAVING\] Treadles = 'four', must be"),
    "shed": ("Rising Shed=true", "Rising Shed=up", r"\[WEAVING\] Rising Shed = 'up', must be true or false"),
    "no table": ("[COLOR TABLE]", "[PRIVATE]", r"\[WARP COLORS\] 1 = 1 is not in \[COLOR TABLE\]"),
    "color": ("2=3\r\n4=3", "2=4\r\n4=3", r"\[WEFT COLORS\] 2 = 4 is not in \[COLOR TABLE\]"),
    "color 0": ("2=3\r\n4=3", "2=0\r\n4=3", r"\[WEFT COLORS\] 2 = 0 is not in \[COLOR TABLE\]"),
    "default": ("Color=2", "Color=9", r"\[WARP\] Color = 9 is not in \[COLOR TABLE\]"),
    "no default": ("Color=2", "", r"\[WARP\] Color is missing, and \[WARP COLORS\] has none for thread 2"),
    "words": ("Color=2", "Color=red", r"\[WARP\] Color = 'red', must be a whole number"),
    "rgb": ("1=999,999,999", "1=999,999", r"\[COLOR TABLE\] 1 = '999,999', must be red, green and blue"),
    "range": (
        "2=999,532,0",
        "2=1000,532,0",
        r"\[COLOR TABLE\] 2 = '1000', .* to 999 \(\[COLOR PALETTE\] Range\)",
    ),
    "no palette": ("[COLOR PALETTE]", "[PRIVATE]", r"\[COLOR TABLE\] 1 = '999', must be a whole number from 0 to 255"),
    "empty range": ("Range=0,999", "Range=999,999", r"\[COLOR PALETTE\] Range = '999,999', must be the least and then"),
    "three": ("Range=0,999", "Range=0,9,9", r"\[COLOR PALETTE\] Range = '0,9,9', must be the least and the most"),
    "units": ("Units=centimeters", "Units=cubits", r"\[WARP\] Units = 'cubits', must be Centimeters, Inches or Deci"),
    "comma": ("Spacing=0.212", "Spacing=0,212", r"\[WARP\] Spacing = '0,212', must be a number, .* with a point"),
    "below": ("Spacing=0.212", "Spacing=-1", r"\[WARP\] Spacing = '-1', must be a number, at least 0"),
    "nan": ("Spacing=0.212", "Spacing=nan", r"\[WARP\] Spacing = 'nan', must be a number"),
    "huge": ("Spacing=0.212", "Spacing=1e999999999", r"\[WARP\] Spacing = '1e999999999', must be a number"),
    "one": ("[WARP SPACING]", "[WARP SPACING]\r\n3=wide", r"\[WARP SPACING\] 3 = 'wide', must be a number"),
    "thick": ("Thickness=0.212", "Thickness=1/3", r"\[WARP\] Thickness = '1/3', must be a number"),
}


@pytest.mark.parametrize("fault", MALFORMED)
def test_what_is_malformed_is_told_by_section_and_key(written, fault):
    old, new, told = MALFORMED[fault]
    assert old in BASE
    with pytest.raises(wy.InputError, match=rf"draft\.wif: {told}"):
        quiet(written(BASE.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", r"has no section \[WIF\]"),
        (b"\n\n", r"has no section \[WIF\]"),
        (codecs.BOM_UTF8, r"has no section \[WIF\]"),
        (b"hello", r"has no section \[WIF\]"),
        (b"[WIF]", r"\[THREADING\] is missing or empty"),
        (b"[WIF]\n[THREADING]\n1=0\n2=\n", r"\[THREADING\] is missing or empty"),
        (b"[WIF]\n[THREADING]\n1=1", r"\[LIFTPLAN\] is missing or empty, and so are \[TIEUP\]"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", "is not text, or damaged"),
        (b"\xff\xfe\x00", "is not text, or damaged"),
        (b"[WIF]\n" + b";" * (1 << 20), "is larger than 1048576 bytes"),
    ],
)
def test_what_is_no_draft(written, data, told):
    with pytest.raises(wy.InputError, match=rf"draft\.wif: {told}"):
        quiet(written(data))


def test_paths_and_options_that_cannot_be(tmp_path):
    with pytest.raises(wy.InputError, match=r"must end in \.wif, \.dtx, \.wpo"):
        wy.read_draft(tmp_path / "draft.txt")
    with pytest.raises(wy.InputError, match="there is no such file"):
        wy.read_draft(tmp_path / "draft.wif")
    (tmp_path / "folder.wif").mkdir()
    with pytest.raises(wy.InputError, match="there is no such file"):
        wy.read_draft(tmp_path / "folder.wif")
    with pytest.raises(wy.InputError, match="rising = 1, must be True, False or None"):
        wy.read_draft(OWN / "fiberworks.wif", rising=1)
    draft = quiet(OWN / "fiberworks.wif")
    with pytest.raises(wy.InputError, match=r"must end in \.wif"):
        wy.write_draft(tmp_path / "draft.dtx", draft)
    with pytest.raises(wy.InputError, match="must be a Draft or a Weave"):
        wy.write_draft(tmp_path / "draft.wif", draft.warp_on_top)
    with pytest.raises(wy.InputError, match="does not exist"):
        wy.write_draft(tmp_path / "missing" / "draft.wif", draft)


def measured(path: Path) -> tuple[wy.Draft | wy.InputError, float, int]:
    """What reading and drawing down a file gives, in s of this process's time, and in bytes at most at once."""

    def draw() -> wy.Draft | wy.InputError:
        try:
            found = quiet(path)
            assert found.warp_on_top.shape == (found.picks, found.ends)
        except wy.InputError as error:
            return error
        return found

    begin = time.process_time()
    draw()
    seconds = time.process_time() - begin
    tracemalloc.start()  # which makes it several times slower
    try:
        return draw(), seconds, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def rows(*values: str) -> str:
    return "\n".join(f"{k}={value}" for k, value in enumerate(values, start=1))


def as_large_as_may_be() -> dict[str, str]:
    """Files up to the largest size, each the worst of a kind."""
    many = ",".join(map(str, range(1, 10_001)))
    straight = rows(*map(str, range(1, 4001)))
    head = "[WIF]\n[WEAVING]\nRising Shed=1\n"
    return {
        "threads": f"{head}[THREADING]\n{straight}\n[LIFTPLAN]\n{straight}",
        "shafts": f"{head}[THREADING]\n{rows(*[many] * 19)}\n[LIFTPLAN]\n{rows(*['10000'] * 1500, many)}",
        "treadles": f"{head}[THREADING]\n1=1\n[TIEUP]\n{rows(*['1'] * 10_000)}\n[TREADLING]\n{rows(*[many] * 18)}",
        "tied": f"{head}[THREADING]\n1=1\n[TIEUP]\n{rows(*[many] * 18)}\n[TREADLING]\n{rows(*['1,2,3,4,5'] * 1500)}",
        "again": f"{head}[THREADING]\n1={'1,' * 500_000}\n[LIFTPLAN]\n1=1",
        "lines": f"{head}[TEXT]\n" + "a=\n" * 340_000,
        "sections": head + "[a]\n" * 260_000,
        "colours": f"{head}[THREADING]\n{straight}\n[LIFTPLAN]\n{straight}\n[COLOR PALETTE]\nRange=1000000\n"
        f"[COLOR TABLE]\n{rows(*[f'{k},{k},{k}' for k in range(9999)])}\n[WARP COLORS]\n{straight}",
        "too many": f"{head}[THREADING]\n{rows(*['1'] * 10_000)}\n[LIFTPLAN]\n{rows(*['1'] * 10_000)}",
    }


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "again")) for kind in as_large_as_may_be()]
)
def test_no_file_takes_long_nor_much(written, kind):
    text = as_large_as_may_be()[kind]
    assert len(text) < reader.MOST_BYTES
    found, seconds, size = measured(written(text))
    assert isinstance(found, wy.Draft) == (kind not in ("lines", "sections", "too many"))
    assert seconds < 1.0 and size < 100e6


def installed(*endings: str) -> list[Path]:
    """Those that dtx-to-wif brings along for its own tests."""
    found = importlib.util.find_spec("dtx_to_wif")
    folder = Path(found.origin).parents[1] / "test_data" if found and found.origin else OWN / "none"
    return sorted(path for path in folder.rglob("*") if path.suffix in endings)


@pytest.mark.parametrize("ending", reader.ENDINGS)
def test_whatever_is_broken_is_a_draft_or_an_input_error(written, ending):
    """Small files with pieces cut out, doubled, exchanged and overwritten."""
    chance = random.Random(1)
    files = sorted(OWN.glob("*.wif")) if ending == ".wif" else installed(ending)
    if not files:
        pytest.skip("dtx-to-wif is not installed")
    originals = [path.read_bytes() for path in files]
    originals = [data for data in originals if len(data) < 5000]
    drafts = 0
    for _ in range(150 if ending == ".wif" else 40):
        data = bytearray(chance.choice(originals))
        for _ in range(chance.randint(1, 4)):
            a, b = sorted(chance.randrange(len(data) + 1) for _ in range(2))
            b = min(b, a + 12)
            kind = chance.randrange(4)
            if kind == 0:
                del data[a:b]
            elif kind == 1:
                data[a:a] = data[a:b]
            elif kind == 2:
                data[a:b] = chance.choice(originals)[a:b]
            else:
                data[a:b] = bytes(chance.choice(b"0123456789=,;[]-.\n\r\t eE%\xff") for _ in range(b - a))
        found, seconds, size = measured(written(bytes(data), f"draft{ending}"))
        drafts += isinstance(found, wy.Draft)
        assert seconds < 1.0 and size < 100e6
    assert drafts  # of some the meaning is still there  # both are tried


# -- files of others ---------------------------------------------------------------------------------------------------


def elsewhere() -> list[Path]:
    return sorted(path for path in Path(ELSEWHERE).rglob("*") if path.suffix in reader.ENDINGS) if ELSEWHERE else []


@pytest.mark.parametrize(
    "path", [*installed(*reader.ENDINGS), *elsewhere()], ids=lambda path: f"{path.parent.name}/{path.name}"
)
def test_files_of_others(path, tmp_path):
    """Those that dtx-to-wif reads have its drawdown, of its own tables, and are written and read the same."""
    dtx_to_wif = pytest.importorskip("dtx_to_wif")
    found, seconds, size = measured(path)
    assert seconds < 1.0 and size < 100e6
    if path.parent.name.startswith("bad_"):
        assert isinstance(found, wy.InputError)
        assert path.suffix != ".wif" or "[" in str(found)
        return
    if path.name == "many color liftplan and zeros.wpo.wif":  # of an older version that wrote (4, 5, 6)=7
        assert "[WARP COLORS] key = '(4'" in str(found)
        return
    assert isinstance(found, wy.Draft), found
    wy.write_draft(tmp_path / "again.wif", found)
    assert wy.read_draft(tmp_path / "again.wif") == found
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pattern = dtx_to_wif.read_pattern_file(path)
    except Exception:
        return  # what it cannot read
    threading = [frozenset(pattern.threading.get(end, set())) for end in range(1, found.ends + 1)]
    for pick in range(1, found.picks + 1):
        if pattern.tieup and pattern.treadling:
            up = set().union(*(pattern.tieup.get(treadle, set()) for treadle in pattern.treadling.get(pick, set())))
        else:
            up = pattern.liftplan.get(pick, set())
        over = {shafts: bool(shafts & (up - {0})) == pattern.is_rising_shed for shafts in set(threading)}
        assert found.warp_on_top[pick - 1].tolist() == [over[shafts] for shafts in threading]
    assert not {end for end, shafts in pattern.threading.items() if shafts - {0} and end > found.ends}


def test_there_are_thirty_files():
    if not installed(".wif"):
        pytest.skip("dtx-to-wif is not installed")
    assert len(installed(".wif")) + len(list(OWN.glob("*.wif"))) > 30


DTX = """@@StartDTX
@@Description
zigzag
@@Info
%%shafts 4
%%treadles 4
%%ends 6
%%picks 5
@@Threading
1 2 3 4 1 2
@@Tieup
0011
0110
1100
1001
@@Treadling
1 2 3 4 3
@@Color Palette
255,0,0
0,0,255
@@Warp Colors
0 0 0 0 0 1
@@Weft Colors
1 1 1 1 1
@@EndDTX
"""


def test_drafts_of_fiberworks_and_weavepoint(written):
    pytest.importorskip("dtx_to_wif")
    draft = quiet(written(DTX, "draft.dtx"))
    np.testing.assert_array_equal(draft.warp_on_top, ZIGZAG)
    assert draft.name == "zigzag"
    np.testing.assert_array_equal(draft.warp_colors[-2:], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for data in (b"", b"@@", b"\x00\x01", DTX.replace("1 2 3 4 3", "1 2 3 4 9").encode(), DTX[:80].encode()):
        for ending in (".dtx", ".wpo"):
            if ending == ".wpo" and data.startswith(b"@@Start"):
                continue
            with pytest.raises(wy.InputError, match=rf"draft{ending}: "):
                quiet(written(data, f"draft{ending}"))


def test_without_dtx_to_wif_it_is_told_what_to_install(written, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "dtx_to_wif", None)
    with pytest.raises(wy.InputError, match=r'pip install "\.\[drafts\]".*pip install .?dtx-to-wif'):
        wy.read_draft(written(DTX, "draft.dtx"))
    quiet(OWN / "fiberworks.wif")  # needs nothing


# -- written and read --------------------------------------------------------------------------------------------------


def some_draft(chance: np.random.Generator) -> wy.Draft:
    ends, picks, shafts, treadles = chance.integers(1, 9, size=4)

    def groups(count: int, most: int) -> list[list[int]]:
        return [chance.permutation(most)[: chance.integers(0, 3)].tolist() for _ in range(count)]

    threading = groups(ends, shafts + 1)
    threading[chance.integers(ends)] = [int(shafts)]
    tieup = [*groups(treadles, shafts + 1), [1]] if chance.random() < 0.5 else None
    treadling = groups(picks, treadles + 1 if tieup else shafts + 1)
    treadling[chance.integers(picks)] = [1]
    lengths = {
        f"{thread}_{kind}": chance.random(count) * 10.0 ** chance.integers(-5, 1)
        for thread, count in (("warp", ends), ("weft", picks))
        for kind in ("spacing", "thickness")
        if chance.random() < 0.7
    }
    high = int(chance.choice([1, 63, 255, 999, 1180, 65535]))
    colors = {
        f"{thread}_colors": chance.integers(0, high + 1, size=(count, 3)) / high
        for thread, count in (("warp", ends), ("weft", picks))
        if chance.random() < 0.7
    }
    return wy.Draft(
        threading=threading,
        treadling=treadling,
        tieup=tieup,
        rising=bool(chance.integers(2)),
        name=str(chance.choice(["", "a", "50 % [wool]; = ünïcode", "[WIF]", "; x"])),
        **lengths,
        **colors,
    )


@pytest.mark.parametrize("seed", range(40))
def test_what_is_written_is_read_the_same(tmp_path, seed):
    """To the last bit: lengths are written in decimal centimetres, and colours in a range in which they are whole."""
    draft = some_draft(np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wy.write_draft(tmp_path / "draft.wif", draft)
        again = wy.read_draft(tmp_path / "draft.wif")
    assert again == draft
    np.testing.assert_array_equal(again.warp_on_top, draft.warp_on_top)
    first = (tmp_path / "draft.wif").read_bytes()
    wy.write_draft(tmp_path / "draft.wif", again)
    assert (tmp_path / "draft.wif").read_bytes() == first


def test_the_drawdown_is_what_the_loom_does():
    """By its definition, end by end and pick by pick."""
    for seed in range(20):
        draft = some_draft(np.random.default_rng(100 + seed))
        for pick, trodden in enumerate(draft.treadling):
            moved = set(trodden) if draft.tieup is None else {s for t in trodden for s in draft.tieup[t - 1]}
            for end, shafts in enumerate(draft.threading):
                assert draft.warp_on_top[pick, end] == (bool(moved & set(shafts)) == draft.rising)


@pytest.mark.parametrize("words", ["2/2 twill Z", "satin 5/2", "2/2 herringbone", "panama 2/2"])
def test_a_weave_gets_the_loom_that_it_needs(tmp_path, words):
    weave = wy.Weave.from_notation(words, rows=22, columns=13)
    wy.write_draft(tmp_path / "draft.wif", weave)
    draft = wy.read_draft(tmp_path / "draft.wif")
    np.testing.assert_array_equal(draft.weave.draft, weave.draft)
    assert draft.name == words == draft.weave.name
    distinct = len(np.unique(weave.draft, axis=0)), len(np.unique(weave.draft, axis=1).T)
    assert (draft.shafts, len(draft.tieup)) in ((distinct[0], distinct[1]), (distinct[0] - 1, distinct[1]))


@pytest.mark.parametrize("tieup", [None, [[], []], [[1], [2]]])
def test_a_loom_that_never_moves_is_written_and_read(tmp_path, tieup):
    path = tmp_path / "draft.wif"
    draft = wy.Draft(threading=[[1], [2], []], treadling=[[], [1] if tieup == [[], []] else []], tieup=tieup)
    assert not draft.warp_on_top.any() and draft.warp_on_top.shape == (2, 3)
    weave = wy.Weave(np.zeros((3, 4)))
    for each in (draft, weave):
        wy.write_draft(path, each)
        with pytest.warns(UserWarning, match="no pick moves a shaft"):
            again = wy.read_draft(path)
        assert again == (draft if each is draft else wy.Draft.from_weave(weave))


# -- drafts in Python --------------------------------------------------------------------------------------------------


def test_a_draft_is_repeated_and_cut_with_all_that_is_known_of_its_threads():
    draft = quiet(OWN / "fiberworks.wif")
    large = draft.tiled(rows=9, columns=12)
    np.testing.assert_array_equal(large.warp_on_top, np.tile(ZIGZAG, (3, 2))[:12, :9])
    np.testing.assert_array_equal(large.warp_colors, np.tile(draft.warp_colors, (2, 1))[:9])
    np.testing.assert_array_equal(large.weft_spacing, np.tile(draft.weft_spacing, 3)[:12])
    assert large.tiled(rows=6, columns=5) == draft
    np.testing.assert_array_equal(large.weave.flipped[1:-1, 1:-1], large.warp_on_top.T[::-1][1:-1, 1:-1])
    small = wy.Draft(threading=[[1], [2]], treadling=[[1], [2]])
    with pytest.raises(wy.InputError, match=r"2 ends and 2 picks makes no cloth.*tiled"):
        _ = small.weave
    np.testing.assert_array_equal(
        small.tiled(rows=5, columns=4).weave.flipped[1:-1, 1:-1],
        wy.Weave.from_notation("plain", rows=5, columns=4).flipped[1:-1, 1:-1],
    )


def test_a_cloth_is_dyed_as_the_draft_says():
    draft = quiet(OWN / "fiberworks.wif").tiled(rows=8, columns=6)
    cloth = wy.fabrics.cotton(rows=8, columns=6, weave=draft.weave)
    dyed = draft.dyed(cloth)
    seen = [dyed.yarns[k].color for k in dyed.material]
    # the last end is the first row
    assert seen[:8] == [tuple(color) for color in draft.warp_colors[::-1].tolist()]
    assert seen[8:] == [tuple(color) for color in draft.weft_colors.tolist()]
    assert len(dyed.yarns) == 3
    np.testing.assert_array_equal(dyed.weave.flipped, draft.weave.flipped)
    paper = wy.paper.cloth(rows=8, columns=6)
    two = draft.dyed(paper)
    assert [two.yarns[k].density for k in two.material] == [paper.yarns[k].density for k in paper.material]
    assert two.friction_damping == paper.friction_damping and two.spacing == paper.spacing
    # numbers by pair of materials stay those of the same crossings
    paired = paper.replace(shear=[[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(draft.dyed(paired).at_nodes("shear"), paired.at_nodes("shear"))
    with pytest.raises(wy.InputError, match="has 8 warp and 6 weft yarns, must have 6 and 5"):
        quiet(OWN / "fiberworks.wif").dyed(cloth)
    with pytest.raises(wy.InputError, match="has no colors"):
        quiet(OWN / "minimum.wif").tiled(rows=8, columns=6).dyed(cloth)
    with pytest.raises(wy.InputError, match="must be a Cloth"):
        draft.dyed(draft)


def test_distances_are_those_of_a_cloth():
    draft = quiet(OWN / "tempoweave.wif")  # of 2.12 mm, but for the second end, of 4.24 mm
    warp, weft = draft.spacing
    # the last end first: the second end is the last row but one
    np.testing.assert_allclose(warp, np.array([2.12, 2.12, 2.12, 3.18, 3.18]) * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(weft, np.full(4, 2.12e-3), rtol=1e-15)
    assert quiet(OWN / "dbweave.wif").spacing is None
    draft = quiet(OWN / "fiberworks.wif")
    assert wy.Cloth(draft.weave, yarns=[wy.paper.YARNS[1]], spacing=draft.spacing).spacing == draft.spacing == 0.00212


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"threading": 5}, "threading = 5, must be a list of lists"),
        ({"threading": [1, 2, 3]}, "must be a list of lists"),
        ({"threading": []}, "threading has 0 entries, must have 1 to 10000"),
        ({"threading": [[1]] * 10_001}, "threading has 10001 entries"),
        ({"threading": [[], [0], []]}, "threading has no end on any shaft"),
        ({"threading": [[-1]]}, r"threading\[0\] = -1, must be a whole number, from 0 to 10000"),
        ({"threading": [[1.5]]}, r"threading\[0\] = 1\.5"),
        ({"treadling": [[1], [3]]}, r"treadling\[1\] = 3, must be a whole number, from 0 to 2"),
        ({"tieup": [[1], [True]]}, r"tieup\[1\] = True"),
        ({"warp_colors": [[0.0, 0.0, 1.1]] * 3}, r"warp_colors has 1\.1, must be from 0 to 1"),
        ({"warp_colors": [[0.0, 0.0, 1.0]] * 2}, r"warp_colors has shape \(2, 3\), must be \(3, 3\)"),
        ({"weft_spacing": [1.0, -1.0]}, "weft_spacing has -1, must be at least 0"),
        ({"weft_thickness": [1.0, np.nan]}, r"weft_thickness\[1\] is nan, must be finite"),
        ({"threading": [[1]] * 5000, "treadling": [[1]] * 5000}, "5000 picks × 5000 ends, must be at most 16000000"),
        ({"threading": [[9000]], "treadling": [[1]] * 5000}, "5000 picks × 9000 shafts"),
    ],
)
def test_drafts_that_cannot_be(changes, told):
    right = {"threading": [[1], [2], [1]], "treadling": [[1], [2]], "tieup": [[1], [2]]}
    wy.Draft(**right)
    with pytest.raises(wy.InputError, match=told):
        wy.Draft(**{**right, **changes})


def test_drafts_are_equal_by_all_that_they_say():
    draft = some_draft(np.random.default_rng(3))
    parts = {name: getattr(draft, name) for name in draft.__dataclass_fields__}
    assert wy.Draft(**parts) == draft and draft != "draft"
    for changes in ({"name": "other"}, {"rising": not draft.rising}, {"warp_spacing": np.full(draft.ends, 2.0)}):
        assert wy.Draft(**{**parts, **changes}) != draft
    with pytest.raises(TypeError, match="unhashable"):
        hash(draft)
