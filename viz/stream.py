"""A sink of steps that streams a run to a recording and to viewers."""

from __future__ import annotations

import itertools
import logging
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from modeler.address_space import check_room
from modeler.regular_files import create_regular, open_regular
from modeler.types import InputError, Step
from modeler.viz import entities, viewer

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from modeler.suggestion import Belief, Suggestions
    from modeler.types import RayImage

_log = logging.getLogger(__name__)

_PATIENCE_S: Final = 5.0  # at the end, until a viewer has received all data
_DISK_PATIENCE_S: Final = 60.0  # with a disk that takes nothing
_ROOM: Final = 9 * 2**29  # bytes of addresses that a run with a recording takes, most of them Rerun's and never used
_BATCH_S: Final = 10.0  # of steps that are written in one piece without a viewer
_GRAPH_DRAWN: Final = 50  # times at most while the number of views doubles: drawing it takes time for each of them


@dataclass(frozen=True, eq=False)
class RerunStream:
    """A recording that grows with every step. No viewer can stop or delay the run."""

    recording: rr.RecordingStream
    """Where steps are drawn."""
    viewers: tuple[viewer.Viewer, ...]
    """The viewers opened for this run."""
    started_s: float
    """When the stream was opened, by `time.monotonic`."""
    file: Path | None = None
    """File of the recording."""
    watched: bool = False
    """Whether it is also sent to a viewer, which may be slow or freeze."""
    advised: bool = False
    """Whether suggestions will follow, for which the layout has a tab."""

    @property
    def address(self) -> str | None:
        """The address to open: the page in the browser, else the port of the window; None without a viewer."""
        return self.viewers[-1].address if self.viewers else None

    def __call__(self, step: Step) -> None:
        """Draw a step."""
        if not self.recording.is_enabled():
            return
        # Rerun takes half a second to import: only runs that record pay for it.
        from modeler.viz import graph_view, images, model_view, pair_view, readings
        from modeler.viz.drawings import shown_posterior

        # A lost frame is retried after later ones: the result is logged at the latest frame.
        self.recording.set_time(entities.FRAME, sequence=max([step.frame.index, *step.views]))
        self.recording.set_time(entities.ELAPSED, duration=time.monotonic() - self.started_s)
        if step.view is not None and set(step.views) == {step.frame.index}:
            self.recording.send_blueprint(_layout(step.view, advised=self.advised))
        of_pair = (
            images.draw_frame,
            pair_view.draw_pair,
            pair_view.draw_posterior,
            pair_view.draw_magnified_posterior,
            images.draw_projected_points,
        )
        repeated = step.last and shown_posterior(step) is None  # the last frame's pair stays in view
        for path, archetype in itertools.chain(
            *(() if repeated else (drawing(step) for drawing in of_pair)),
            model_view.draw_model(step),
            model_view.draw_merged_clouds(step),
            graph_view.draw_newest_camera(step),
            *((graph_view.draw_graph(step), graph_view.draw_uncertainty(step)) if graph_due(step) else ()),
            readings.draw_readings(step),
            readings.draw_text(step),
        ):
            self.recording.log(path, archetype)

    def advise(self, step: Step, belief: Belief, found: Suggestions) -> None:
        """Draw the belief and the suggestions after a step; may be called from another thread."""
        if not self.recording.is_enabled():
            return
        from modeler.viz import next_view

        self.recording.set_time(entities.FRAME, sequence=max([step.frame.index, *step.views]))
        self.recording.set_time(entities.ELAPSED, duration=time.monotonic() - self.started_s)
        for path, archetype in next_view.draw_next(belief, found):
            self.recording.log(path, archetype)

    def close(self) -> None:
        """Complete the recording. A window stays open with its data; a page in the browser ends."""
        if self.watched:
            try:
                self.recording.flush(timeout_sec=_PATIENCE_S)
            except RuntimeError as error:
                _log.info("the viewer did not receive all data: %s", error)
        # Disconnecting completes the file, but first takes leave of the viewers, and for ever of one that is frozen.
        leave = threading.Thread(target=self.recording.disconnect, daemon=True)
        leave.start()
        self._wait(leave)
        for own in self.viewers:
            if own.process.poll() is not None:
                _log.warning("the viewer was closed before the run had ended; the recording holds what it missed")
            elif leave.is_alive() or not own.lasting:
                own.stop()
        self._wait(leave)

    def _wait(self, leave: threading.Thread) -> None:
        """Wait until the recording is complete, but no longer than the file grows: a viewer or a disk may hang."""
        size = -1
        while leave.is_alive() and (grown := self._size()) != size:
            size = grown
            leave.join(_PATIENCE_S if self.watched else _DISK_PATIENCE_S)

    def _size(self) -> int:
        """Return the size of the file in bytes; 0 without one."""
        return self.file.stat().st_size if self.file is not None and self.file.exists() else 0


def graph_due(step: Step) -> bool:
    """Return whether the whole graph is to be drawn again: with every view, later with every second and so on."""
    count = len(step.views)
    return step.last or count % max(1, count // _GRAPH_DRAWN) == 0


def load() -> None:
    """Import what streams need, which takes half a second, ahead of `open_stream`.

    Raises:
        OSError: if memory does not suffice.
    """
    if "rerun" not in sys.modules:
        check_room(_ROOM)
    from modeler.viz import blueprint, drawings, images, readings  # noqa: F401  # pyright: ignore[reportUnusedImport]


def open_stream(
    name: str,
    *,
    save: Path | None,
    spawn: bool = False,
    web: bool = False,
    connect: str | None = None,
    facts: Mapping[str, object] | None = None,
    advised: bool = False,
) -> RerunStream:
    """Open a recording and the viewer that is to watch it.

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

    from modeler.viz import drawings, images, readings

    listens = connect is not None and viewer.reachable(connect)
    sinks: list[rr.FileSink | rr.GrpcSink] = [] if save is None else [_file_sink(save)]
    viewers = _own_viewers(spawn=spawn, web=web)
    sinks += [rr.GrpcSink(own.sink) for own in viewers]
    if listens:
        sinks.append(rr.GrpcSink(connect))
    elif connect is not None:
        _log.warning("--connect %s: no viewer listens there; the run goes on without it", connect)
    watched = listens or bool(viewers)
    # Rerun keeps metadata of every piece that it writes in memory: 0.4 MB a frame, if each frame is written by itself.
    pieces = None if watched else rr.ChunkBatcherConfig(flush_tick=_BATCH_S)
    recording = rr.RecordingStream(entities.APPLICATION, default_enabled=bool(sinks), batcher_config=pieces)
    if sinks:
        try:
            recording.set_sinks(*sinks)
        except RuntimeError as error:  # the disk has become full since
            raise InputError(f"{save}: cannot write the recording ({error}); choose another folder") from error
        recording.send_recording_name(name)
        recording.send_blueprint(_layout(None, advised=advised))
        for path, archetype in itertools.chain(
            drawings.draw_axes(),
            images.draw_area_colours(),
            readings.draw_legend(name, facts or {}),
        ):
            recording.log(path, archetype, static=True)
    return RerunStream(recording, viewers, time.monotonic(), save, watched=watched, advised=advised)


def _layout(first: RayImage | None, *, advised: bool) -> rrb.Blueprint:
    """Return the layout, with a tab for suggestions if they will follow."""
    from modeler.viz import blueprint, next_view

    return blueprint.layout(first, (next_view.tab(first),) if advised else ())


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


_BEGINNING = 4096  # bytes: Rerun 0.41 waits for ever for a file whose beginning it could not write


def _file_sink(save: Path) -> rr.FileSink:
    """Return the sink that writes a file.

    Raises:
        InputError: if it cannot be written.
    """
    import rerun as rr

    try:
        create_regular(save)
        save.write_bytes(bytes(_BEGINNING))
        os.truncate(save, 0)
    except OSError as error:
        raise InputError(f"{save}: cannot write the recording ({error.strerror}); choose another folder") from error
    return rr.FileSink(save)


_BEGINS, _ENDS = b"RRF2", b"FOOT"
_LAST = 64  # bytes that hold the end mark


def ends_whole(recording: Path) -> bool:
    """Return whether a recording is complete: one cut off by a kill or a full disk has no footer.

    Recordings of other formats count as complete.
    """
    with open_regular(recording) as file:
        if file.read(len(_BEGINS)) != _BEGINS:
            return True
        file.seek(max(0, os.fstat(file.fileno()).st_size - _LAST))
        return _ENDS in file.read()
