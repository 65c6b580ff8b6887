"""What is done before each step: a hook and functions set its inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..device.exclusive import ALONE, compiling
from ..errors import InputError

if TYPE_CHECKING:
    from .stepper import Stepper


def prepare(stepper: Stepper) -> None:
    """Lets a hook and functions set the inputs of the next step; a chunk is one step then.

    Raises:
        InputError: a hook that made steps, or set the state.
    """
    if stepper.before_step is None and not stepper.model.inputs.functions:
        return
    with ALONE:
        stepper.settle()
    if stepper.before_step is not None:
        before = _fixed(stepper)
        stepper.before_step()
        if _fixed(stepper) != before:
            raise InputError("a hook made steps or set the state, may read it and set inputs")
    if stepper.model.inputs.functions:
        with ALONE, compiling():
            stepper.settle()
            stepper.model.inputs.evaluate(stepper.steps_done, stepper.frames.state().position)


def _fixed(stepper: Stepper) -> tuple[Any, ...]:
    """Gives what a hook may not change: the steps that were made, and the frames that are kept."""
    recording = stepper.frames.recording
    return stepper.steps_done, stepper.frames.filled, recording, recording is not None and recording.open
