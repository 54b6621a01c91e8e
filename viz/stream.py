"""A sink of steps that streams a run to a recording and to viewers."""

from __future__ import annotations

import itertools
import logging
import os
import queue
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from modeler.system.processes import check_room
from modeler.system.regular_files import PIECE_BYTES, create_regular
from modeler.types import Event, InputError, Step, checked
from modeler.viz import entities, viewer

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from modeler.suggestion import Belief, Suggestions
    from modeler.types import RayImage


_PATIENCE_S: Final = 5.0  # at the end, until viewers have received all data
_DISK_PATIENCE_S: Final = 60.0  # with a disk that takes nothing
_QUEUED: Final = 100  # steps that viewers are behind at most, besides those that Rerun keeps


class RecordingFile:
    """A file that Rerun writes through a pipe: Rerun 0.41 waits for ever at the end of a file that it could not write.

    What the disk does not take is dropped; the file then ends there. If it is moved or removed meanwhile, it is written
    once more in its place, unless something else is there.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, or empty it."""
        self.path = path
        self.error: OSError | None = None
        """Why the file is cut off, if it is."""
        self.went_away = False
        """Whether it was moved or removed meanwhile."""
        try:
            create_regular(path)
            path.write_bytes(bytes(4096))  # which must fit to begin with
            self._file = path.open("r+b", buffering=0)
            self._file.truncate(0)
        except OSError as error:
            raise InputError(f"{path}: cannot write the recording ({error.strerror}); choose another folder") from error
        self._source, self._written = -1, 0
        self._copying = threading.Thread(target=self._copy, daemon=True, name="recording")

    def attach(self, recording: rr.RecordingStream) -> None:
        """Have a stream written to the file."""
        import rerun as rr

        self._source, sink = os.pipe()
        try:
            # A footer lists all pieces, each of which takes 25 kB of memory until the end.
            recording.set_sinks(rr.FileSink(f"/dev/fd/{sink}", write_footer=False))
        finally:
            os.close(sink)  # Rerun has opened it anew
        self._copying.start()

    def close(self, recording: rr.RecordingStream) -> None:
        """Complete the file, or give up a disk that takes nothing for a minute."""
        leave = threading.Thread(target=recording.disconnect, daemon=True)
        leave.start()
        if not _ended((leave, self._copying), _DISK_PATIENCE_S, lambda: self._written):
            self.error = self.error or TimeoutError("the disk does not answer")
            let_go()
        if self.error is not None:
            what = "was moved or removed, and cannot be written again" if self.went_away else "is truncated"
            why = self.error.strerror or self.error
            _log.warning("%s: %s (%s); the other files do not depend on it", self.path, what, why)
        elif self.went_away:
            _log.warning("%s: was moved or removed during the run; it is written again", self.path)

    def _copy(self) -> None:
        """Copy to the file what Rerun writes."""
        with open(self._source, "rb", buffering=0) as source, self._file as file:
            self._fill(file, source)
            try:
                if self.error is None and not self._in_place(file):
                    self.went_away = True
                    file.seek(0)
                    with self.path.open("xb", buffering=0) as again:
                        self._fill(again, file)
            except OSError as error:
                self.error = error

    def _fill(self, file: FileIO, source: FileIO) -> None:
        """Write to a file all that can be read, until the disk takes no more."""
        while piece := source.read(PIECE_BYTES):
            while piece and self.error is None:
                try:
                    written = file.write(piece)
                except OSError as error:
                    self.error = error
                else:
                    self._written += written
                    piece = piece[written:]

    def _in_place(self, file: FileIO) -> bool:
        """Return whether a file still has its name."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(file.fileno()))
        except FileNotFoundError:
            return False


class Shown:
    """What viewers are shown, sent from a thread of its own: Rerun 0.41 waits for a viewer that is 400 MB behind."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._waiting: queue.Queue[Callable[[rr.RecordingStream], object] | None] = queue.Queue(_QUEUED)
        self._behind = False
        self._sending = threading.Thread(target=self._send, daemon=True, name="viewers")
        self._sending.start()

    def put(self, act: Callable[[rr.RecordingStream], object] | None, patience_s: float = 0.0) -> None:
        """Have something done with the stream, None: its end; once the viewers are too far behind, nothing more is."""
        try:
            if not self._behind:
                self._waiting.put(act, timeout=patience_s)
        except queue.Full:
            self._behind = True
            _log.warning("the viewer takes no data any more; the run goes on without it")

    def close(self, end_hung: Callable[[], object]) -> None:
        """Send the rest, and take leave.

        Args:
            end_hung: ends the viewers that are ours, called where they do not take it.
        """
        self.put(None, _PATIENCE_S)
        if self._behind or not _ended((self._sending,), _PATIENCE_S, lambda: 0):
            _log.info("the viewer did not receive all data")
            self._behind = True
            end_hung()
            if not _ended((self._sending,), viewer.STOP_S, lambda: 0):
                let_go()

    def _send(self) -> None:
        while (act := self._waiting.get()) and not self._behind:
            act(self._recording)
        self._recording.disconnect()


def _ended(threads: tuple[threading.Thread, ...], patience_s: float, progress: Callable[[], int]) -> bool:
    """Wait for threads for as long as there is progress, and return whether they have ended."""
    before = -1
    while (now := progress()) != before and any(thread.is_alive() for thread in threads):
        before = now
        for thread in threads:
            thread.join(patience_s)
    return not any(thread.is_alive() for thread in threads)


def let_go() -> None:
    """Let the process end without what Rerun still has: its exit hook would wait for that for ever."""
    if "rerun" in sys.modules:
        import rerun as rr

        rr.unregister_shutdown()


_log = logging.getLogger(__name__)

_ROOM: Final = 9 * 2**29  # bytes of addresses that a run with a recording takes, most of them Rerun's and never used


@dataclass(frozen=True, eq=False)
class RerunStream:
    """A recording that grows with every step. No viewer can stop or delay the run."""

    recording: rr.RecordingStream
    """Where steps are recorded."""
    viewers: tuple[viewer.Viewer, ...]
    """The viewers opened for this run."""
    started_s: float
    """When the stream was opened, by `time.monotonic`."""
    file: RecordingFile | None = None
    shown: Shown | None = None
    """What viewers are shown, which may be slow or freeze; None without a viewer."""
    advised: bool = False
    """Whether suggestions will follow, for which the layout has a tab."""

    @property
    def address(self) -> str | None:
        """The address to open: the page in the browser, else the port of the window; None without a viewer."""
        return self.viewers[-1].address if self.viewers else None

    def __call__(self, step: Event) -> None:
        """Draw an event of a run. Only steps are drawn."""
        if not (isinstance(step, Step) and self.drawn):
            return
        # Rerun takes half a second to import: only runs that record pay for it.
        from modeler.viz import graph_view, images, model_view, pair_view, readings
        from modeler.viz.drawings import shown_posterior

        if step.view is not None and set(step.views) == {step.frame.index}:
            self.lay_out(_layout(step.view, advised=self.advised))
        of_pair = (
            images.draw_frame,
            pair_view.draw_pair,
            pair_view.draw_posterior,
            images.draw_projected_points,
        )
        of_all = (
            model_view.draw_model,
            model_view.draw_merged_clouds,
            graph_view.draw_graph,
            graph_view.draw_uncertainty,
        )
        due = all_due(step)
        repeated = step.last and shown_posterior(step) is None  # the last frame's pair stays in view
        unchanged = step.view is None and not step.last
        drawings = (
            *(() if repeated else of_pair),
            *(() if unchanged else (graph_view.draw_newest_camera, *(of_all if due else ()))),
            readings.draw_readings,
            partial(readings.draw_text, with_model=due),
        )
        self.draw(step, itertools.chain(*(drawing(step) for drawing in drawings)))

    def advise(self, step: Step, belief: Belief, found: Suggestions) -> None:
        """Draw the belief and the suggestions after a step; may be called from another thread."""
        if not self.drawn:
            return
        from modeler.viz.model_view import draw_next

        self.draw(step, draw_next(belief, found))

    @property
    def drawn(self) -> bool:
        """Whether anything is drawn."""
        return self.file is not None or self.shown is not None

    def draw(self, step: Step | None, drawings: Iterable[tuple[str, Any]]) -> None:
        """Draw archetypes by entity at the time of a step; None: for all times."""
        # A lost frame is retried after later ones: the result is logged at the latest frame.
        self.draw_at(None if step is None else max([step.frame.index, *step.views]), drawings)

    def draw_at(self, frame: int | None, drawings: Iterable[tuple[str, Any]]) -> None:
        """Draw archetypes by entity at a frame; None: for all times."""
        drawn, elapsed_s = tuple(drawings), time.monotonic() - self.started_s

        def log(recording: rr.RecordingStream) -> None:
            if frame is not None:
                recording.set_time(entities.FRAME, sequence=frame)
                recording.set_time(entities.ELAPSED, duration=elapsed_s)
            for path, archetype in drawn:
                recording.log(path, archetype, static=frame is None)

        self.send(log)

    def lay_out(self, blueprint: rrb.Blueprint) -> None:
        """Change the layout of the viewer."""
        self.send(lambda recording: recording.send_blueprint(blueprint))

    def send(self, act: Callable[[rr.RecordingStream], object]) -> None:
        """Do the same with the file and with what viewers are shown."""
        if self.file is not None:
            act(self.recording)
        if self.shown is not None:
            self.shown.put(act)

    def close(self) -> None:
        """Complete the recording. A window stays open with its data; a page in the browser ends."""
        for own in self.viewers:
            if own.process.poll() is not None:
                _log.warning("the viewer was closed before the run had ended; the recording holds what it missed")
        if self.file is not None:
            self.file.close(self.recording)
        if self.shown is not None:
            self.shown.close(lambda: [own.stop() for own in self.viewers])
        for own in self.viewers:
            if not own.lasting:
                own.stop()


def all_due(step: Step) -> bool:
    """Return whether the model and the graph are to be drawn again: with every view, later with every second and so on.

    So they cost a frame of thousands no more than one of hundreds.
    """
    count = len(step.views)
    return step.last or count % max(1, count // 50) == 0


def load() -> None:
    """Import what streams need, which takes half a second, ahead of `open_stream`.

    Raises:
        OSError: if memory does not suffice.
    """
    if "rerun" not in sys.modules:
        check_room(_ROOM)
        # Rerun's and Arrow's allocators keep what other threads free, 2 kB a frame, unless they give it back at once.
        os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")
    from modeler.viz import blueprint, drawings, images, readings  # noqa: F401  # pyright: ignore[reportUnusedImport]


@checked
def open_stream(
    name: str,
    *,
    save: str | Path | None = None,
    spawn: bool = False,
    web: bool = False,
    connect: str | None = None,
    facts: Mapping[str, object] | None = None,
    advised: bool = False,
) -> RerunStream:
    """Open a recording and the viewer that is to watch it: a sink of a run's events, to be closed at the end.

    A viewer that does not start or cannot be reached is reported to the log and left out.

    Args:
        name: of the recording in the viewer.
        save: file to record to; None records nowhere.
        spawn: open the viewer in a window.
        web: serve the viewer in the browser on 127.0.0.1; `address` names the page.
        connect: `rerun+http://HOST:PORT/proxy` of a viewer that is already open.
        facts: settings of the run, by name, which the viewer shows.
        advised: whether suggestions will follow.

    Raises:
        InputError: if `save` cannot be written, or `connect` is not an address.
        OSError: if memory does not suffice.
    """
    load()
    import rerun as rr

    from modeler.viz import images, readings

    listens = connect is not None and viewer.reachable(connect)
    file = None if save is None else RecordingFile(Path(save))
    viewers = _own_viewers(spawn=spawn, web=web)
    sinks = [rr.GrpcSink(own.sink) for own in viewers]
    if listens:
        sinks.append(rr.GrpcSink(connect))
    elif connect is not None:
        _log.warning("`connect` %s: no viewer listens there; the run goes on without it", connect)
    pieces = rr.ChunkBatcherConfig(flush_tick=1.0)  # until then, a step takes 0.15 MB of memory
    same = uuid.uuid4()  # for viewers, in which the file is opened later
    recording = rr.RecordingStream(
        entities.APPLICATION, recording_id=same, default_enabled=file is not None, batcher_config=pieces
    )
    shown = None
    if file is not None:
        file.attach(recording)
    if sinks:
        live = rr.RecordingStream(entities.APPLICATION, recording_id=same)
        live.set_sinks(*sinks)
        shown = Shown(live)
    stream = RerunStream(recording, viewers, time.monotonic(), file, shown, advised=advised)
    if stream.drawn:
        stream.send(lambda recording: recording.send_recording_name(name))
        stream.lay_out(_layout(None, advised=advised))
        legend = readings.draw_legend(name, facts or {})
        axes = ((path, rr.ViewCoordinates.RDF) for path in (entities.PAIR, entities.WORLD, entities.TRACKED))
        stream.draw(None, itertools.chain(axes, images.draw_area_colours(), legend))
    return stream


def _layout(first: RayImage | None, *, advised: bool) -> rrb.Blueprint:
    """Return the layout, with a tab for suggestions if they will follow."""
    from modeler.viz import blueprint
    from modeler.viz.model_view import next_tab

    return blueprint.layout(first, (next_tab(first),) if advised else ())


def _own_viewers(*, spawn: bool, web: bool) -> tuple[viewer.Viewer, ...]:
    """Start the requested viewers; those that fail are logged and left out."""
    viewers: list[viewer.Viewer] = []
    for wanted, start in ((spawn, viewer.start_window), (web, viewer.start_web)):
        if wanted:
            try:
                viewers.append(start())
            except InputError as error:
                _log.warning("%s; the run goes on without it", error)
    return tuple(viewers)
