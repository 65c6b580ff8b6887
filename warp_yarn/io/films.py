"""Files of frames in the making: each appears when its run ends, however it ends, with the frames that it has."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..simulation.state import End, State, Trajectory
from .files import atomic_write, deferred, ended_by_exception, room

RECORDINGS = (".npz", ".h5", ".hdf5")
"""How the names of recordings end."""
MARGIN = 1 << 17
"""Bytes of a file that no frame counts for: lists of what is where."""


class Film:
    """A file of frames in the making, in a folder of its own beside where it shall appear.

    Args:
        path: where it shall appear.
        reserve: bytes that are kept free on the disk, for what is written where it is full.

    Attributes:
        frames: how many it has.
    """

    def __init__(self, path: str | os.PathLike, reserve: int):
        self.path, self.frames = Path(path), 0
        self._whole = atomic_write(path)
        self.temporary: Path = self._whole.__enter__()
        self._reserve = self.temporary.with_name("reserve")
        try:
            if reserve:
                with open(self._reserve, "wb") as file:
                    for _ in range(0, reserve + MARGIN, MARGIN):
                        file.write(bytes(MARGIN))
        except BaseException:
            self._whole.__exit__(*sys.exc_info())
            raise

    def add(self, state: State) -> None:
        """Writes a frame, or keeps it until there are more."""
        raise NotImplementedError

    def close(self, end: End | None) -> None:
        """Writes what is left, and makes the file whole."""
        raise NotImplementedError

    def drop(self) -> None:
        """Closes the file, which nobody wants any more."""

    def take(self, state: State) -> None:
        """Adds a frame."""
        try:
            self.add(state)
        except OSError as error:
            self._make_room()
            if error.filename is not None or str(self.path) in str(error):
                raise
            raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(self.path)) from error
        self.frames += 1

    def needs(self, size: int) -> None:
        """Looks whether so many bytes can be written, before a library leaves half of them and does not survive it.

        Raises:
            OSError: the disk is full, or the file larger than this process may write.
        """
        if size + MARGIN > room(self.temporary):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))

    def _make_room(self) -> None:
        self._reserve.unlink(missing_ok=True)

    def finish(self, end: End | None) -> None:
        """Makes the file appear, with the frames that were added; without any there is none."""
        self._make_room()
        try:
            if self.frames:
                self.close(end)
        except BaseException:
            self.drop()
            self._whole.__exit__(*sys.exc_info())
            raise
        if self.frames:
            self._whole.__exit__(None, None, None)
        else:
            self.discard()

    def discard(self) -> None:
        """Leaves no file."""
        self.drop()
        self._whole.__exit__(_NoFrames, _NoFrames(), None)

    @contextlib.contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Leaves no file where the block does not end well."""
        try:
            yield
        except BaseException:
            self.discard()
            raise


class _NoFrames(Exception):
    """What a file ends with that has no frame."""


class Films:
    """Films of one run, which get the same frames.

    Attributes:
        frames: how many they got.
        wanted: whether they are to appear with what they have: not before they have more than what was there.
        end: what a run goes on from that leaves these frames.
    """

    def __init__(self, films: Sequence[Film]):
        self.films, self.frames, self.wanted = films, 0, True
        self.end: End | None = None

    def take(self, frames: Iterable[State]) -> None:
        """Adds frames, each to all of the films or to none."""
        for frame in frames:
            with deferred():
                for film in self.films:
                    film.take(frame)
                self.frames += 1


@contextlib.contextmanager
def open_films(makers: Iterable[Callable[[], Film]]) -> Iterator[Films]:
    """Opens films, which appear when the block ends, however it does; SIGTERM ends it as Ctrl-C does.

    Raises:
        OSError: a film cannot be written; the others are.
    """
    films: list[Film] = []
    result = Films(films)
    with ended_by_exception():
        try:
            for make in makers:
                with deferred():
                    films.append(make())
            yield result
        finally:
            with deferred():
                failures = []
                for film in films:
                    try:
                        if result.wanted:
                            film.finish(result.end)
                        else:
                            film.discard()
                    except OSError as error:
                        failures.append(error)
                if failures:
                    raise failures[0]


def film(
    path: str | os.PathLike, head: Trajectory, written: dict[str, Any], shown: dict[str, Any]
) -> Callable[[], Film]:
    """Chooses what writes a file by its ending, and checks the options.

    Args:
        head: a trajectory without frames.
        written: precision and compression of recordings.
        shown: of USD files, as of ``write_usd``.

    Returns:
        What opens the film.

    Raises:
        InputError: an option out of its range, or another ending.
    """
    # each loads a library that the other does without
    from . import recordings, usd

    recordings.of_options(**written)
    look = usd.options(**shown)
    ending = Path(path).suffix
    if ending in usd.ENDINGS:
        return lambda: usd.Stage(path, head, look)
    if ending in RECORDINGS:
        return lambda: recordings.recording(path, head, **written)
    raise InputError(f"path = {str(path)!r}, must end in {', '.join((*usd.ENDINGS, *RECORDINGS))}; movies: write_mp4")
