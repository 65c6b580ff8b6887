"""Recordings: the cloth, its scene, frames, and what a run goes on from, as .npz or HDF5 files, written frame by frame.

    .npz   ``position_000000.npy``, … a block of frames each (or ``position.npy``, all of them), and beside them the
           cloth and the scene. A zip file, whole after every block.
    HDF5   ``position`` [frames, nodes, 3], … a dataset each, and the cloth and the scene in ``head``, the bytes of
           an .npz.

What does not change in a scene, such as (u, v) where yarns do not slide, is one frame. In single precision positions
are relative to ``origin``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, choice, finite_array, integer, missing_extra
from ..simulation.state import FIELDS, WIDTHS, End, State, Trajectory
from .files import atomic_write
from .films import Film

if TYPE_CHECKING:
    import h5py

HDF5 = (".h5", ".hdf5")
BLOCK_BYTES = 4 << 20
"""Of frames that are kept until they are written together."""
STILL = ("euler", "euler_velocity", "anchor")
"""What does not change where yarns do not slide."""
PRECISIONS = {"double": np.float64, "single": np.float32}


def of_options(precision: Any, compression: Any) -> tuple[Any, int]:
    """Gives the type of the frames' numbers and the level of compression, or an InputError."""
    kind = PRECISIONS[choice("precision", precision, PRECISIONS)]
    return kind, integer("compression", compression, least=0, most=9)


# -- writing ----------------------------------------------------------------------------------------------------------


class Recording(Film):
    """A recording in the making: keeps frames until there is a block of them, and then writes that.

    Args:
        path: where it shall appear.
        head: all but the frames.
        precision, compression: as of ``Simulator.record``.
    """

    def __init__(self, path: str | os.PathLike, head: Trajectory, precision: str, compression: int):
        self.kind, self.compression = of_options(precision, compression)
        self.head, self.nodes = head, head.cloth.nodes
        self.moving = [name for name in FIELDS if head.scene is None or head.scene.sliding or name not in STILL]
        frame = sum(WIDTHS[name] for name in self.moving) * self.nodes * np.dtype(self.kind).itemsize
        self.block = max(1, BLOCK_BYTES // frame)
        self.origin = np.zeros(3)
        self.pending: list[State] = []
        self.written = 0
        beside = sum(np.asarray(value).nbytes for value in head.head().values()) + 8 * sum(WIDTHS.values()) * self.nodes
        self._size = frame
        super().__init__(path, reserve=self.block * frame + beside)

    def add(self, state: State) -> None:
        if not self.written and not self.pending:
            if self.kind is np.float32:
                self.origin = state.position.mean(axis=0)
            self.begin(state)
        self.pending.append(state)
        if len(self.pending) >= self.block:
            self.flush()

    def flush(self) -> None:
        """Writes the frames that are kept."""
        if self.pending:
            self.needs(len(self.pending) * self._size)
            values = {name: np.stack([getattr(state, name) for state in self.pending]) for name in self.moving}
            values["position"] -= self.origin
            self.append({name: np.ascontiguousarray(value, dtype=self.kind) for name, value in values.items()})
            self.written += len(self.pending)
            self.pending = []

    def beside(self, first: State) -> dict[str, Any]:
        """Gives what is written once: the origin, and what stays as in the first frame."""
        still = {name: getattr(first, name)[None] for name in FIELDS if name not in self.moving}
        return {"origin": self.origin, **still}

    def begin(self, first: State) -> None:
        """Writes what comes before the first block."""
        raise NotImplementedError

    def append(self, values: dict[str, np.ndarray]) -> None:
        """Writes a block of frames: all of it, or, where that fails, nothing."""
        raise NotImplementedError

    def close(self, end: End | None) -> None:
        self.flush()
        self.write_head(dataclasses.replace(self.head, end=end).head())

    def write_head(self, head: dict[str, Any]) -> None:
        """Writes all but the frames."""
        raise NotImplementedError


class Npz(Recording):
    """A recording as an .npz: a zip file that is whole after every block."""

    blocks = 0

    def begin(self, first: State) -> None:
        self._first = first
        self._put({})

    def append(self, values: dict[str, np.ndarray]) -> None:
        self._put({f"{name}_{self.blocks:06d}": value for name, value in values.items()})
        self.blocks += 1

    def write_head(self, head: dict[str, Any]) -> None:
        self._put({**head, **self.beside(self._first)})

    def _put(self, values: dict[str, Any]) -> None:
        """Adds arrays; where that fails, the file is as before."""
        method = zipfile.ZIP_DEFLATED if self.compression else zipfile.ZIP_STORED
        exists = self.temporary.exists()
        start, directory = _directory(self.temporary) if exists else (0, b"")
        try:
            with zipfile.ZipFile(
                self.temporary, "a" if exists else "w", method, compresslevel=self.compression
            ) as archive:
                for name, value in values.items():
                    buffer = io.BytesIO()
                    np.lib.format.write_array(buffer, np.asanyarray(value), allow_pickle=False)
                    archive.writestr(f"{name}.npy", buffer.getbuffer())
        except BaseException:
            # what was there before fits; a handle that zipfile left open writes nothing more
            if exists:
                with open(self.temporary, "r+b") as file:
                    file.truncate(start)
                    file.seek(start)
                    file.write(directory)
            raise


def _directory(path: Path) -> tuple[int, bytes]:
    """Reads where a zip file's directory begins, and all from there."""
    with zipfile.ZipFile(path) as archive:
        start = archive.start_dir
    with open(path, "rb") as file:
        file.seek(start)
        return start, file.read()


class Hdf5(Recording):
    """A recording as an HDF5 file, which others read too."""

    def __init__(self, *arguments: Any):
        self._file: h5py.File | None = None
        self._h5py = _h5py()
        super().__init__(*arguments)

    def begin(self, first: State) -> None:
        self._file = file = self._h5py.File(self.temporary, "w")
        packed = {} if not self.compression else {"compression": self.compression, "shuffle": True}
        for name in self.moving:
            row = (self.nodes, WIDTHS[name])
            # of about 64 kB, which is read at a time
            frames = max(1, min(self.block, (1 << 16) // (row[0] * row[1] * np.dtype(self.kind).itemsize)))
            shape = {"shape": (0, *row), "maxshape": (None, *row), "chunks": (frames, *row)}
            file.create_dataset(name, dtype=self.kind, **shape, **packed)
        for name, value in self.beside(first).items():
            file[name] = value
        file["time_step"], file["start"] = self.head.step, self.head.start * self.head.step / self.head.every
        file["time_step"].attrs["unit"] = file["start"].attrs["unit"] = "s"
        file.flush()

    def append(self, values: dict[str, np.ndarray]) -> None:
        assert self._file is not None
        try:
            for name, value in values.items():
                self._file[name].resize(self.written + len(value), axis=0)
                self._file[name][self.written :] = value
            self._file.flush()
        except BaseException:
            for name in values:
                self._file[name].resize(self.written, axis=0)
            raise

    def write_head(self, head: dict[str, Any]) -> None:
        assert self._file is not None
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **head)
        self._file["head"] = np.frombuffer(buffer.getbuffer(), dtype=np.uint8)
        self._file.close()
        self._file = None

    def drop(self) -> None:
        if self._file is not None:
            with contextlib.suppress(Exception):
                self._file.close()


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise missing_extra("h5py", "HDF5 files need", "data") from error
    return h5py


def recording(path: str | os.PathLike, head: Trajectory, precision: str, compression: int) -> Recording:
    """Opens a recording by its path's ending, .npz or one of HDF5."""
    kind = Hdf5 if Path(path).suffix in HDF5 else Npz
    return kind(path, head, precision, compression)


def save(path: str | os.PathLike, trajectory: Trajectory, precision: str, compression: int) -> None:
    """Writes a trajectory (see ``Trajectory.save``): an .npz with an array of all frames each, as NumPy would."""
    end = trajectory.end
    if end is None and precision == "single" and len(trajectory):
        end = End(trajectory[-1], trajectory.steps_done)
    if Path(path).suffix in HDF5:
        film = recording(path, trajectory[:0], precision, compression)
        with film.all_or_nothing():
            for k in range(len(trajectory)):
                film.take(trajectory[k])
        film.finish(end)
        return
    kind, level = of_options(precision, compression)
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    values: dict[str, Any] = {name: getattr(trajectory, name) for name in FIELDS}
    if kind is np.float32 and len(trajectory):
        values["origin"] = trajectory.position[0].mean(axis=0)
        values["position"] = trajectory.position - values["origin"]
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", method, compresslevel=level) as archive:
        for name, value in {**dataclasses.replace(trajectory, end=end).head(), **values}.items():
            array = np.asanyarray(value, dtype=kind if name in FIELDS else None)
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


# -- reading ----------------------------------------------------------------------------------------------------------


def load(path: str | os.PathLike, frames: slice | None) -> Trajectory:
    """Reads a recording (see ``Trajectory.load``)."""
    with _named(path), _source(Path(path)) as source:
        head = Trajectory.of_head(source.head)
        count = source.count()
        if not count:
            raise InputError("has no frame, must have at least one")
        taken = range(count)[slice(None) if frames is None else frames]
        origin = source.array("origin") if source.has("origin") else 0.0
        values: dict[str, Any] = {}
        for name in FIELDS:
            value = source.read(name, taken, count)
            values[name] = finite_array(name, value, (len(taken), head.cloth.nodes, WIDTHS[name]))
        values["position"] += origin
        whole = dataclasses.replace(head, **values)
        if frames is None:
            return whole
        # which frames they are, as of a trajectory that had all of them
        there: dict[str, Any] = {name: np.empty((count, 0, 0)) for name in FIELDS}
        return dataclasses.replace(dataclasses.replace(head, **there)[frames], **values)


def is_one(path: str | os.PathLike) -> bool:
    """Tells whether an HDF5 file is a recording, and not one of the paper's published data."""
    try:
        with _h5py().File(path) as file:
            return "head" in file
    except OSError:
        return False


def head_of(path: str | os.PathLike) -> tuple[Trajectory, int]:
    """Reads all but the frames of a recording, and counts them."""
    with _named(path), _source(Path(path)) as source:
        return Trajectory.of_head(source.head), source.count()


def stream(path: str | os.PathLike) -> Iterator[State]:
    """Reads the frames of a recording one after the other, a few at a time."""
    head, count = head_of(path)
    few = max(1, BLOCK_BYTES // (8 * sum(WIDTHS.values()) * head.cloth.nodes))
    with _named(path), _source(Path(path)) as source:
        if not source.in_parts:
            few = count
    for begin in range(0, count, few):
        frames = load(path, slice(begin, begin + few))
        yield from (frames[k] for k in range(len(frames)))


@contextlib.contextmanager
def _named(path: str | os.PathLike) -> Iterator[None]:
    """Names the file in what is wrong with it."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{Path(path)}: there is no such file") from error
    except InputError as error:
        raise InputError(f"{Path(path)}: {error}") from error
    except OSError as error:
        if isinstance(error, BlockingIOError):
            raise InputError(f"{Path(path)}: another program has it open to write to it ({error})") from error
        raise InputError(f"{Path(path)}: not a recording of warp_yarn ({error})") from error
    except Exception as error:  # zip, pickle and key errors of a foreign or truncated file
        raise InputError(f"{Path(path)}: not a recording of warp_yarn ({error})") from error


@contextlib.contextmanager
def _source(path: Path) -> Iterator[_Source]:
    if path.suffix in HDF5:
        if not path.is_file():
            raise FileNotFoundError(path)
        with _h5py().File(path) as file, np.load(io.BytesIO(file["head"][()].tobytes())) as head:
            yield _Source(head, file)
    else:
        with np.load(path) as data:
            yield _Source(data, data)


class _Source:
    """An open recording: its head, and where its frames are."""

    def __init__(self, head: Mapping[str, Any], data: Any):
        self.head, self.data = head, data
        self.blocks: dict[str, list[str]] = {}
        for name in FIELDS:
            numbered = sorted(key for key in data if key.startswith(f"{name}_") and key[len(name) + 1 :].isdigit())
            self.blocks[name] = numbered or [name]

    @property
    def in_parts(self) -> bool:
        """Whether some of its frames can be read without the others."""
        return self.data is not self.head or len(self.blocks["position"]) > 1

    def has(self, name: str) -> bool:
        return name in self.data

    def array(self, name: str) -> np.ndarray:
        return self.data[name][()]

    def count(self) -> int:
        """Counts the frames that all of the arrays have that change."""
        first, *others = self.blocks["position"]
        self._first = np.atleast_1d(self.data[first]) if self.data is self.head else self.data[first]
        length = len(self._first)
        return length if not others else length * len(others) + len(self.data[others[-1]])

    def read(self, name: str, frames: range, count: int) -> np.ndarray:
        """Reads some of the frames of an array; where it has one that stays, that."""
        blocks = self.blocks[name]
        if len(blocks) == 1:
            array = self._first if name == "position" else self.data[blocks[0]]
            if len(array) == 1 < count:
                return np.broadcast_to(array[()], (len(frames), *array.shape[1:]))
            return array[frames.start : frames.stop : frames.step] if len(frames) else array[:0]
        # all of them have as many frames as the first, but for the last
        parts, length = [], len(self._first)
        for k in sorted({frame // length for frame in frames}):
            mine = np.array([frame - k * length for frame in frames if frame // length == k])
            parts.append(self.data[blocks[k]][mine])
        return np.concatenate(parts) if parts else self.data[blocks[0]][:0]
