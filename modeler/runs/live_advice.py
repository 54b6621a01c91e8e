"""Suggests the next action during a live run, to a person who turns the object in front of the camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modeler.pipeline import Modeler
    from modeler.suggestion import Belief, Suggestions
    from modeler.types import Step

Receiver = Callable[["Step", "Belief", "Suggestions"], None]  # receives the belief and the suggestions after a step


@contextmanager
def advising(modeler: Modeler, *receivers: Receiver) -> Iterator[Callable[[Step], None]]:
    """Compute suggestions after steps in a separate thread; of steps that arrive meanwhile, only the newest is used.

    Exceptions are raised with the next step, or at the end.
    """
    waiting: deque[Step] = deque(maxlen=1)

    def advise() -> None:
        from modeler.suggestion import suggest

        try:
            step = waiting.pop()
        except IndexError:  # a newer one was processed instead
            return
        belief = modeler.belief(step.views, step.solution, step.edges_so_far)
        found = suggest(belief)
        for each in receivers:
            each(step, belief, found)

    with ThreadPoolExecutor(1, thread_name_prefix="advice") as thread:
        asked: deque[Future[None]] = deque()

        def put(step: Step) -> None:
            while asked and asked[0].done():
                asked.popleft().result()
            if step.accepted and step.views:
                waiting.append(step)
                asked.append(thread.submit(advise))

        yield put
        waiting.clear()
        for future in asked:
            future.result()


def summary_of(found: Suggestions) -> str:
    """Return the next action in a few words, of those that need no input to the run: a poke needs `prior` poke."""
    best = next((each for each in found.ranked if each.prediction.candidate.action in ("turn", "lay")), None)
    if found.reached or best is None:
        return "nothing more to gain"
    return f"next: {best.words.split(':')[0]}"
