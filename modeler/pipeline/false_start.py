"""Whether a run began with something else than the object: then nothing after it joins, and a person should know."""

from __future__ import annotations

from collections.abc import Callable

from modeler.pipeline.state import State
from modeler.types import InputError, Outcome, Posterior, RayImage

_FEW = 3  # joined frames that may show a hand, or something that was taken away
_IN_A_ROW = 5  # lost frames from which on it is asked


def false_start(state: State, register: Callable[[RayImage, RayImage], Posterior]) -> str:
    """Return in one line which frames may show something else than the object, and what to do; "": no doubt.

    Args:
        state: what is known so far.
        register: two lost frames with each other, of which a match speaks against those that joined.
    """
    begun = max((state.places[frame] for frame in state.views), default=-1)
    lost = [frame for frame, place in state.places.items() if frame in state.lost and place > begun]
    if (
        state.warned
        or not 0 < len(state.views) <= _FEW
        or len(lost) < _IN_A_ROW
        or lost[-2:] != list(state.places)[-2:]
    ):
        return ""
    before, newest = (state.lost[frame].view for frame in lost[-2:])
    try:
        matches = before is not None and newest is not None and register(newest, before).outcome is Outcome.CONVERGED
    except InputError:
        return ""
    first, last = min(state.views), max(state.views)
    joined = f"frame {first}" if first == last else f"frames {first} to {last}"
    words = (
        f"nothing from frame {lost[0]} on matches {joined}, yet frames {lost[-2]} and {lost[-1]} match each other: if "
        f"something else than the object was in view before, --frames {lost[0]}: leaves it out"
    )
    return words if matches else ""
