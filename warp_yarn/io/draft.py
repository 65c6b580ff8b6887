"""Weavers' drafts from files and to files."""

from __future__ import annotations

import io
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from ..description.draft import Draft
from ..description.weave import Weave
from ..errors import InputError, missing_extra
from .draft_wif import Reading, Sections, sections_of, text_of
from .files import atomic_write

if TYPE_CHECKING:
    from dtx_to_wif import PatternData

MOST_BYTES = 1 << 20
"""Of a file. A draft of 4000 × 4000 threads with all that WIF can say of them has half of that."""

ENDINGS = (".wif", ".dtx", ".wpo")


def read_draft(path: str | os.PathLike, *, rising: bool | None = None) -> Draft:
    """Reads a draft from a WIF file; or from one of Fiberworks (.dtx) or WeavePoint (.wpo), which needs
    ``warp_yarn[drafts]``.

    What real programs write is read, even where it is not quite WIF: other capitals, comments behind values, missing
    or sparse colours, more treadles tied up than counted, a palette of 0 to 999, Latin-1. What is left out, or taken
    for granted, is a UserWarning.

    Args:
        path: ending in .wif, .dtx or .wpo.
        rising: whether shafts rise (True) or sink, instead of what the file says. A file that does not say is taken as
            rising, with a warning.

    Raises:
        InputError: there is no such file, it is larger than 1 MiB, not a draft, or damaged; of a WIF file naming
            section and key.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"path = {str(path)!r}, must end in {', '.join(ENDINGS)}")
    if not (rising is None or isinstance(rising, bool)):
        raise InputError(f"rising = {rising!r}, must be True, False or None")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise InputError(f"{path}: is larger than {MOST_BYTES} bytes, must be at most as large")
    try:
        sections = sections_of(_decoded(data)) if ending == ".wif" else _foreign(data, ending, path.name)
        reading = Reading(sections, rising)
        draft = reading.draft(path.stem)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    for message in reading.told:
        warnings.warn(f"{path}: {message}", stacklevel=2)
    return draft


def write_draft(path: str | os.PathLike, draft: Draft | Weave) -> None:
    """Writes a draft as a WIF file (version 1.1), which ``read_draft`` reads back as the same draft. It appears whole
    or not at all.

    Args:
        path: ending in .wif.
        draft: the draft; or a Weave, which gets the shafts and treadles that it needs. Colours are exact where they are
            all whole parts of 65535 or of a number up to 4095, as of all files, or else to 1/131070.

    Raises:
        InputError: an argument is something else, or the folder of `path` does not exist.
        OSError: it cannot be written.
    """
    if Path(path).suffix.lower() != ".wif":
        raise InputError(f"path = {str(path)!r}, must end in .wif")
    if isinstance(draft, Weave):
        draft = Draft.from_weave(draft)
    if not isinstance(draft, Draft):
        raise InputError(f"draft = {draft!r}, must be a Draft or a Weave")
    with atomic_write(path) as temporary:
        temporary.write_text(text_of(draft), encoding="utf-8", newline="\r\n")


def _decoded(data: bytes) -> str:
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    for coding in ["utf-16"] if wide else ["utf-8-sig", "latin-1"]:
        try:
            text = data.decode(coding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise InputError("is not text, or damaged, must be a WIF file")


def _foreign(data: bytes, ending: str, name: str) -> Sections:
    """Reads another program's file by dtx-to-wif, and says the same as a WIF file would."""
    try:
        import dtx_to_wif
    except ImportError as error:
        raise missing_extra("dtx-to-wif", f"files of {ending} need", "drafts") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about defaults, of which Reading has its own
            if ending == ".dtx":
                pattern = dtx_to_wif.dtx_reader.read_dtx(io.StringIO(_decoded(data)), name)
            else:
                pattern = dtx_to_wif.wpo_reader.read_wpo(io.BytesIO(data), name)
    except InputError:
        raise
    except Exception as error:  # what it says of damaged files is of every kind
        raise InputError(f"not a whole {ending} file ({type(error).__name__}: {error})") from error
    return _sections(pattern)


def _sections(pattern: PatternData) -> Sections:
    def numbered(values: dict) -> dict[str, str]:
        return {
            str(key): ",".join(map(str, sorted(value) if isinstance(value, set) else value))
            if isinstance(value, set | tuple)
            else str(value)
            for key, value in values.items()
        }

    sections: Sections = {
        "TEXT": {"TITLE": pattern.name},
        "WEAVING": {
            "SHAFTS": str(pattern.num_shafts),
            "TREADLES": str(pattern.num_treadles),
            "RISING SHED": str(pattern.is_rising_shed),
        },
        "THREADING": numbered(pattern.threading),
        "TIEUP": numbered(pattern.tieup),
        "TREADLING": numbered(pattern.treadling),
        "LIFTPLAN": numbered(pattern.liftplan),
        "COLOR TABLE": numbered(pattern.color_table),
    }
    if pattern.color_range is not None:
        sections["COLOR PALETTE"] = {"RANGE": ",".join(map(str, pattern.color_range))}
    for thread in ("warp", "weft"):
        values = vars(getattr(pattern, thread))
        keys = ("threads", "color", "spacing", "thickness", "units")
        sections[thread.upper()] = {key.upper(): str(values[key]) for key in keys if values[key] is not None}
        for kind in ("colors", "spacing", "thickness"):
            sections[f"{thread.upper()} {kind.upper()}"] = numbered(getattr(pattern, f"{thread}_{kind}"))
    return sections
