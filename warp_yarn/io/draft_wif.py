"""The text of WIF files (version 1.1), to and from a Draft.

Our own reader: the one library that is kept up, dtx-to-wif, ends in an endless loop on an empty file, refuses what real
programs write (sparse colours, Range=999, comments behind values), and its errors name neither section nor key.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import re
from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from ..description.draft import MOST_THREADS, OF_THREADS, Draft
from ..errors import InputError

Sections = dict[str, dict[str, str]]
"""Values as they are written, by section and key in capitals."""

NUMBERED = (
    "COLOR TABLE", "THREADING", "TIEUP", "TREADLING", "LIFTPLAN", "WARP COLORS", "WEFT COLORS", "WARP SPACING",
    "WEFT SPACING", "WARP THICKNESS", "WEFT THICKNESS",
)  # fmt: skip
"""Sections whose keys are numbers; a line without a value is an empty one."""

NAMED = ("WIF", "WEAVING", "COLOR PALETTE", "WARP", "WEFT", "TEXT")
"""Others that are read. [CONTENTS] is not to be trusted."""

UNITS = {"CENTIMETERS": Fraction(1, 100), "INCHES": Fraction(254, 10000), "DECIPOINTS": Fraction(254, 7200000)}
"""Metres."""

YES, NO = ("TRUE", "YES", "ON", "1"), ("FALSE", "NO", "OFF", "0")

RANGES = (255, 999, *range(1, 4096), 65535)
"""Of colours that are written, from 0 to this: the first in which all of them are exact, or else the last."""


def sections_of(text: str) -> Sections:
    """Splits a file.

    Raises:
        InputError: it is no WIF file, or something stands where it does not belong.
    """
    sections: Sections = {}
    name = ""
    # not splitlines: what it takes for the end of a line, too, stands in titles
    for number, raw in enumerate(re.split(r"\r\n|\r|\n", text), start=1):
        line = raw.strip()
        if not line or line[0] in ";#":
            continue
        if line[0] == "[":
            name, bracket, _ = line[1:].partition("]")
            if not bracket:
                raise InputError(f"line {number}: {line[:40]!r} has no ]")
            name = " ".join(name.split()).upper()
            sections.setdefault(name, {})
        elif name in NUMBERED or name in NAMED:
            _add(sections[name], name, line)
    if "WIF" not in sections:
        raise InputError("has no section [WIF], which every WIF file has")
    return sections


def _add(section: dict[str, str], name: str, line: str) -> None:
    key, equals, value = line.partition("=")
    if name != "TEXT":
        if not equals:
            key = key.partition(";")[0]
        value = value.partition(";")[0]
        if not equals and name not in NUMBERED:
            raise InputError(f"[{name}] {line[:40]!r} has no =")
    key, value = " ".join(key.split()).upper(), value.strip()
    if name in NUMBERED and re.fullmatch(r"\+?[0-9]{1,9}", key):
        key = str(int(key))  # 01 is 1
    if section.get(key, value) != value and name != "TEXT":
        raise InputError(f"[{name}] {key} is there twice, as {section[key][:40]!r} and as {value[:40]!r}")
    section[key] = value


@dataclasses.dataclass(frozen=True)
class Reading:
    """A file that is read.

    Args:
        sections: what it says.
        rising: whether shafts rise, instead of what it says; None: as it says.
    """

    sections: Sections
    rising: bool | None
    told: list[str] = dataclasses.field(default_factory=list)
    """What was left out, or taken for granted."""

    def draft(self, name: str) -> Draft:
        """Makes its draft. ``name``: where it has no title.

        Raises:
            InputError: naming section and key.
        """
        threading = self._groups("THREADING", self._count("WARP", "THREADS"))
        if not any(threading):
            raise InputError("[THREADING] is missing or empty")
        tieup, treadling = self._trodden()
        counts = {"warp": len(threading), "weft": len(treadling)}
        self._tell_unused(counts, "TREADLING" if tieup is not None else "LIFTPLAN")
        known: dict[str, Any] = {}
        for thread, count in counts.items():
            known[f"{thread}_colors"] = self._colors(thread.upper(), count)
            for kind in OF_THREADS[1:]:
                known[f"{thread}_{kind}"] = self._lengths(thread.upper(), kind.upper(), count)
        result = Draft(
            threading=threading,
            treadling=treadling,
            tieup=tieup,
            rising=self._rising(),
            name=self._value("TEXT", "TITLE") or name,
            **known,
        )
        shafts = self._count("WEAVING", "SHAFTS") or result.shafts
        if shafts < result.shafts:
            self.told.append(
                f"[WEAVING] Shafts = {shafts}, but shaft {result.shafts} is used: taken as {result.shafts}"
            )
        return result

    # -- what moves ----------------------------------------------------------------------------------------------------

    def _trodden(self) -> tuple[list[list[int]] | None, list[list[int]]]:
        """Finds the tie-up and treadling, which count where there is a liftplan too; or None and the liftplan."""
        picks = self._count("WEFT", "THREADS")
        treadling, tied, lifted = (self._any(section, "0") for section in ("TREADLING", "TIEUP", "LIFTPLAN"))
        if not (treadling and tied) and not lifted:
            # nothing moves; is that what it says?
            treadling, tied, lifted = (self._any(section) for section in ("TREADLING", "TIEUP", "LIFTPLAN"))
            if lifted or (treadling and tied):
                self.told.append("no pick moves a shaft")
        if treadling and tied:
            # Fiberworks ties up treadles beyond the last that it counts
            tieup = self._groups("TIEUP", None)
            most = max(len(tieup), self._count("WEAVING", "TREADLES") or 0)
            tieup += [[] for _ in range(most - len(tieup))]
            return tieup, self._groups("TREADLING", picks, most, "the last of [TIEUP] and of [WEAVING] Treadles")
        if lifted:
            return None, self._groups("LIFTPLAN", picks)
        if not (treadling or tied):
            raise InputError(
                "[LIFTPLAN] is missing or empty, and so are [TIEUP] and [TREADLING]: must have it, or both"
            )
        missing, there = ("TIEUP", "TREADLING") if treadling else ("TREADLING", "TIEUP")
        raise InputError(f"[{missing}] is missing or empty, which [{there}] needs")

    def _any(self, section: str, but: str = "") -> bool:
        """Tells whether a section says anything, at all, or but this."""
        return any(value.strip(but + ", \t") for value in self.sections.get(section, {}).values())

    def _rising(self) -> bool:
        if self.rising is not None:
            return self.rising
        value = self._value("WEAVING", "RISING SHED") or ""
        if value.upper() in YES + NO:
            return value.upper() in YES
        if value:
            raise InputError(f"[WEAVING] Rising Shed = {value[:40]!r}, must be true or false")
        self.told.append("[WEAVING] Rising Shed is missing: taken as true. rising=False says that shafts sink")
        return True

    def _tell_unused(self, counts: dict[str, int], moving: str) -> None:
        """Says where there are more threads than are threaded or trodden: WeavePoint counts what it has room for."""
        for (thread, count), section in zip(counts.items(), ("THREADING", moving), strict=True):
            threads = self._count(thread.upper(), "THREADS")
            if threads is not None and threads > count:
                self.told.append(
                    f"[{thread.upper()}] Threads = {threads}, of which [{section}] uses {count}: the rest is left out"
                )

    def _groups(self, section: str, count: int | None, most: int = MOST_THREADS, within: str = "") -> list[list[int]]:
        """Reads lists of numbers from 0 to most, up to the last one that is there. ``count``: of threads."""
        found = {}
        for key, value in self.sections.get(section, {}).items():
            number = _whole(f"[{section}] key", key, 1, MOST_THREADS)
            items = {item.strip() for item in value.split(",")} - {""}
            group = sorted({_whole(f"[{section}] {key}", item, 0, most, within) for item in items} - {0})
            if group and number > (count or MOST_THREADS):
                thread = "WARP" if section == "THREADING" else "WEFT"
                raise InputError(f"[{section}] {key} must be at most {count} ([{thread}] Threads)")
            if number <= (count or MOST_THREADS):
                found[number] = group
        return [found.get(k, []) for k in range(1, max(found, default=0) + 1)]

    # -- what is known of threads --------------------------------------------------------------------------------------

    def _colors(self, thread: str, count: int) -> np.ndarray | None:
        """Reads red, green and blue of every thread [count, 3] from 0 to 1."""
        default = self._value(thread, "COLOR") or ""
        single = {k: v for k, v in self._numbered(f"{thread} COLORS", count).items() if v}
        table = {k: v for k, v in self._numbered("COLOR TABLE", MOST_THREADS, least=0).items() if v}
        if not single and not (default and table):
            return None
        rgb: dict[int, list[float]] = {}
        result = np.empty((count, 3))
        for number in range(1, count + 1):
            where, value = f"[{thread} COLORS] {number}", single.get(number)
            if value is None:
                where, value = f"[{thread}] Color", default
                if not value:
                    raise InputError(f"[{thread}] Color is missing, and [{thread} COLORS] has none for thread {number}")
            # of an index and red, green, blue, the index counts
            index = _whole(where, value.split(",")[0].strip(), 0, MOST_THREADS)
            if index not in rgb:
                if index not in table:
                    raise InputError(f"{where} = {index} is not in [COLOR TABLE]")
                rgb[index] = self._color(index, table[index])
            result[number - 1] = rgb[index]
        return result

    def _color(self, index: int, value: str) -> list[float]:
        low, high = self._range
        items = [item.strip() for item in value.split(",") if item.strip()]
        if len(items) != 3:
            raise InputError(f"[COLOR TABLE] {index} = {value[:40]!r}, must be red, green and blue")
        within = "[COLOR PALETTE] Range"
        return [(_whole(f"[COLOR TABLE] {index}", item, low, high, within) - low) / (high - low) for item in items]

    @property
    def _range(self) -> tuple[int, int]:
        """The least and most of red, green and blue; 0 to 255 where the file does not say."""
        value = self._value("COLOR PALETTE", "RANGE") or "0,255"
        items = [item.strip() for item in value.split(",") if item.strip()]
        where = "[COLOR PALETTE] Range"
        if len(items) not in (1, 2):
            raise InputError(f"{where} = {value[:40]!r}, must be the least and the most, such as 0,255")
        low, high = (_whole(where, item, 0, 10**6) for item in (["0", *items] if len(items) == 1 else items))
        if low >= high:
            raise InputError(f"{where} = {value[:40]!r}, must be the least and then the most")
        return low, high

    def _lengths(self, thread: str, kind: str, count: int) -> np.ndarray | None:
        """Reads spacing or thickness of every thread [count] (m); None where that of one is not known."""
        section, key = f"{thread} {kind}", kind.capitalize()
        default = self._value(thread, kind) or ""
        single = {k: v for k, v in self._numbered(section, count).items() if v}
        if not single and not default:
            return None
        units = self._value(thread, "UNITS") or ""
        if not units:
            self.told.append(f"[{thread}] Units is missing: {key} is left out")
            return None
        if units.upper() not in UNITS:
            raise InputError(f"[{thread}] Units = {units[:40]!r}, must be Centimeters, Inches or Decipoints")
        unit = UNITS[units.upper()]
        result = np.full(count, _length(f"[{thread}] {key}", default, unit) if default else np.nan)
        for number, value in single.items():
            result[number - 1] = _length(f"[{section}] {number}", value, unit)
        if np.isnan(result).any():
            number = int(np.isnan(result).argmax()) + 1
            self.told.append(
                f"[{thread}] {key} is missing, and [{section}] has none for thread {number}: it is left out"
            )
            return None
        return result

    # -- values --------------------------------------------------------------------------------------------------------

    def _value(self, section: str, key: str) -> str | None:
        return self.sections.get(section, {}).get(key)

    def _count(self, section: str, key: str) -> int | None:
        """Reads a number of threads, shafts or treadles; None where it is missing, or 0."""
        value = self._value(section, key)
        return (_whole(f"[{section}] {key.capitalize()}", value, 0, MOST_THREADS) if value else 0) or None

    def _numbered(self, section: str, count: int, least: int = 1) -> dict[int, str]:
        """Gives the values of the threads that there are, by number."""
        values = {}
        for key, value in self.sections.get(section, {}).items():
            values[_whole(f"[{section}] key", key, least, MOST_THREADS)] = value
        return {k: value for k, value in values.items() if k <= count}


def _whole(where: str, text: str, least: int, most: int, within: str = "") -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,9}", text) or not least <= int(text) <= most:
        because = f" ({within})" if within else ""
        raise InputError(f"{where} = {text[:40]!r}, must be a whole number from {least} to {most}{because}")
    return int(text)


def _length(where: str, text: str, unit: Fraction) -> float:
    """Reads a length (m), correctly rounded: so that one that is written is read as it was."""
    if not re.fullmatch(r"([0-9]{1,40}\.?[0-9]{0,400}|\.[0-9]{1,400})(e[+-]?[0-9]{1,2})?", text, flags=re.IGNORECASE):
        raise InputError(f"{where} = {text[:40]!r}, must be a number, at least 0, with a point for its decimals")
    return float(Fraction(text) * unit)


# -- writing ----------------------------------------------------------------------------------------------------------


def text_of(draft: Draft) -> str:
    """Writes a draft as a WIF file, every thread in a line of its own, as all programs can read it."""
    version = importlib.metadata.version("warp_yarn")
    body: dict[str, list[str]] = {
        "TEXT": [f"Title={draft.name}"],
        "WEAVING": [
            f"Shafts={draft.shafts}",
            f"Treadles={0 if draft.tieup is None else len(draft.tieup)}",
            f"Rising Shed={str(draft.rising).lower()}",
        ],
    }
    palette: dict[tuple[float, ...], int] = {}
    for thread, count in (("warp", draft.ends), ("weft", draft.picks)):
        section = body[thread.upper()] = [f"Threads={count}", "Units=Centimeters"]
        colors = getattr(draft, f"{thread}_colors")
        if colors is not None:
            index = [palette.setdefault(tuple(color), len(palette) + 1) for color in colors.tolist()]
            section.append(f"Color={index[0]}")
            body[f"{thread.upper()} COLORS"] = _numbered(index)
        for kind in OF_THREADS[1:]:
            lengths = getattr(draft, f"{thread}_{kind}")
            if lengths is not None:
                texts = [_centimeters(length) for length in lengths.tolist()]
                section.append(f"{kind.capitalize()}={texts[0]}")
                if len(set(texts)) > 1:
                    body[f"{thread.upper()} {kind.upper()}"] = _numbered(texts)
    if palette:
        colors = np.array(list(palette))
        high = next((high for high in RANGES if (np.round(colors * high) / high == colors).all()), RANGES[-1])
        body["COLOR PALETTE"] = [f"Entries={len(colors)}", "Form=RGB", f"Range=0,{high}"]
        body["COLOR TABLE"] = _numbered(
            [",".join(map(str, color)) for color in np.round(colors * high).astype(int).tolist()]
        )
    body["THREADING"] = _numbered(map(_group, draft.threading))
    if draft.tieup is None:
        body["LIFTPLAN"] = _numbered(map(_group, draft.treadling))
    else:
        body["TIEUP"] = _numbered(map(_group, draft.tieup))
        body["TREADLING"] = _numbered(map(_group, draft.treadling))
    head = {
        # the date and the address are the format's own: there are programs that know no others
        "WIF": [
            "Version=1.1",
            "Date=April 20, 1997",
            "Developers=wif@mhsoft.com",
            "Source Program=warp_yarn",
            f"Source Version={version}",
        ],
        "CONTENTS": [f"{name}=true" for name in body],
    }
    return "\n".join("\n".join([f"[{name}]", *lines, ""]) for name, lines in {**head, **body}.items())


def _numbered(values: Any) -> list[str]:
    return [f"{number}={value}" for number, value in enumerate(values, start=1)]


def _group(numbers: Sequence[int]) -> str:
    return ",".join(map(str, numbers)) or "0"


def _centimeters(metres: float) -> str:
    return format(Decimal(repr(metres)).scaleb(2), "f")
