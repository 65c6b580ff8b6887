"""How large kernels, classes and modules may be, and that functions' docstrings say what they do: as verbs."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = {
    file.relative_to(ROOT).as_posix(): file
    for folder in ("kernels", "warp_yarn")
    for file in sorted((ROOT / folder).rglob("*.py"))
}

MOST = {"kernel": 16, "class": 200, "module": 400}
"""Arguments of a kernel, or of what it calls; lines of a class and of a module."""

VERBS = set(
    re.findall(
        r"\w+",
        """
        accept accumulate add adjoin adjust advance allocate allow answer append apply approximate ask assemble assert
        average begin bring build calibrate call capture carry catch change check choose clamp clear clip close
        coarsen collect combine come compare complete compute confirm constrain continue convert copy correct count
        cut damp decide declare decorate define delete describe differentiate distribute divide do drag draw drop
        end enter erase estimate evaluate exchange expand extend extrapolate factorize fail fetch fill find finish
        fit flatten follow forget free freeze gather get give go group guess halve hand hold identify ignore import
        initialize insert install integrate interpolate invert iterate join judge keep know launch learn leave let
        limit linearize list load look lower lump make mark match measure merge minimize mirror mix move multiply name
        normalize note number open pack parse pass pay perform pick place plot prepare prescribe press print probe
        produce project propagate prove pull push put raise reach read ready rebuild recall receive record recover
        reduce refine refuse register release remember remove rename reorder repeat replace replay report request reset
        resolve restore restrict retreat return reverse rewrite rise roll rotate round run sample save say scale
        scan scatter search seed select send separate set settle shape shorten show shrink shuffle simulate skip
        slide smooth solve sort split spread square start stop store stretch subtract sum swap sweep switch
        symmetrize take tell test throw tidy total track transform translate transpose trust try turn unpack update
        use validate view visit wait walk warn weave weigh write yield zero
        """,
    )
)
"""What functions do: a new verb is added here."""


def stems(word: str) -> set[str]:
    """Verbs of which a word may be the imperative or the third person."""
    word = word.lower()
    return {word, word.removesuffix("s"), word.removesuffix("es"), re.sub("ies$", "y", word)}


def begins_with_a_verb(docstring: str) -> bool:
    """A sum is a noun where it is one of something."""
    first, second = re.match(r"([A-Za-z]*),?\s*(\S*)", docstring).groups()
    return bool(stems(first) & VERBS) and second != "of"


def larger(name: str, source: str) -> dict[str, int]:
    """What of a module is larger than it may be."""
    lines, found = len(source.splitlines()), {}
    if lines > MOST["module"]:
        found[name] = lines
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            size, most = node.end_lineno - node.lineno + 1, MOST["class"]
        elif isinstance(node, ast.FunctionDef) and name.startswith("kernels/"):
            size, most = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs), MOST["kernel"]
        else:
            continue
        if size > most:
            found[f"{name} {node.name}"] = size
    return found


def without_verb(source: str) -> list[str]:
    """Functions whose docstring begins with something else; properties are read as attributes are, and may be nouns."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node)
            is_property = any(re.search(r"property|\.setter$", ast.unparse(d)) for d in node.decorator_list)
            if docstring is not None and not is_property and not begins_with_a_verb(docstring):
                found.append(f"{node.name}: {docstring.splitlines()[0]}")
    return found


def test_sizes_are_counted():
    arguments = ", ".join(f"a{k}" for k in range(17))
    kernel = f"def f({arguments}):\n    pass\n"
    body = "    a = 1\n" * 200
    assert larger("kernels/x.py", kernel) == {"kernels/x.py f": 17}
    assert larger("warp_yarn/x.py", kernel) == {}
    assert larger("warp_yarn/x.py", f"class A:\n{body}") == {"warp_yarn/x.py A": 201}
    assert larger("warp_yarn/x.py", "a = 1\n" * 401) == {"warp_yarn/x.py": 401}
    assert larger("warp_yarn/x.py", f"class A:\n{body[10:]}" + "a = 1\n" * 200) == {}


def test_nothing_is_larger():
    """What has a good reason to be is named here, with the reason."""
    assert len(FILES) > 50
    found = {}
    for name, file in FILES.items():
        found |= larger(name, file.read_text())
    assert not found


@pytest.mark.parametrize("docstring", ["Makes a part.", "Choose.", "Copies it", "Passes", "Tries", "Ends, and"])
def test_verbs_are_verbs(docstring):
    assert begins_with_a_verb(docstring)


@pytest.mark.parametrize(
    "docstring", ["A part.", "As of Model.", "q = A p", "Positions of it.", "(θ, sin θ)", "Whether"]
)
def test_others_are_none(docstring):
    assert not begins_with_a_verb(docstring)


def test_docstrings_of_functions_begin_with_a_verb():
    found = {name: without_verb(file.read_text()) for name, file in FILES.items()}
    assert not {name: functions for name, functions in found.items() if functions}


def test_slow_tests_are_there():
    """Names that no test has any more would hide that they are quick."""
    for name in (ROOT / "tests" / "slow.txt").read_text().splitlines():
        file, *_, function = name.split("[")[0].split("::")
        # tests of a term's class are those of checks.py
        text = (ROOT / file).read_text() + (ROOT / "tests" / "checks.py").read_text()
        assert re.search(rf"^ *def {function}\(", text, flags=re.M), name
