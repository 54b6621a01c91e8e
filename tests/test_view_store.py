"""Views on disk are the views that were put there, and the memory of a run does not grow with them."""

import mmap
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tabletop
from test_pipeline import COLOURED, Oracle, modeler

from modeler.pipeline import Run
from modeler.pipeline.state import State
from modeler.segmentation import Scene
from modeler.system.disk_arrays import ViewStore
from modeler.types import RayImage, Step

VIEW = tabletop.view(tabletop.Box((0.06, 0.045, 0.08)), tabletop.turntable(1)[0], 0)


def arrays(view: RayImage) -> dict[str, np.ndarray]:
    frame = view.frame
    return {"depth": frame.depth_m, "mask": frame.mask, "colour": frame.colour, "points": view.points_m} | {
        "normals": view.normals,
        "pixels": view.pixels,
    }


def on_disk(view: RayImage) -> bool:
    def mapped(array: object) -> bool:
        return mapped(array.base) if isinstance(array, np.ndarray) else isinstance(array, memoryview | mmap.mmap)

    return all(mapped(array) for array in arrays(view).values())


def test_views_go_to_disk_once_memory_is_full_and_stay_what_they_were() -> None:
    size = sum(array.nbytes + 64 for array in arrays(VIEW).values())
    store = ViewStore(memory_bytes=2 * size, chunk_bytes=-(-2 * size // 2**16) * 2**16)
    rng = np.random.default_rng(0)
    made = [replace(VIEW, points_m=VIEW.points_m + rng.normal(size=VIEW.points_m.shape)) for _ in range(12)]
    kept = [store.keep(view) for view in made]
    assert not any(view.layers for view in kept)
    assert [on_disk(view) for view in kept] == [False] * 2 + [True] * 10
    for view, same in zip(made, kept, strict=True):
        for name, array in arrays(same).items():
            np.testing.assert_array_equal(array, arrays(view)[name])
            assert (array.dtype, array.flags.writeable) == (arrays(view)[name].dtype, True)


def test_where_nothing_can_be_written_views_stay_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(prefix: str) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    kept = ViewStore(memory_bytes=0).keep(VIEW)
    assert not on_disk(kept)
    np.testing.assert_array_equal(kept.points_m, VIEW.points_m)


def test_a_run_with_its_views_on_disk_has_the_same_result() -> None:
    def last(store: ViewStore) -> Step:
        hidden = frozenset({2, 3})
        run = Run(modeler(registrar=Oracle(noise=1.0, blind=hidden)), Scene(), State(store=store))
        events = [*run.track(COLOURED), *run.revisit(), *run.refine(), *run.finish()]
        assert isinstance(events[-1], Step)
        return events[-1]

    one, other = last(ViewStore()), last(ViewStore(memory_bytes=0, chunk_bytes=2**22))
    assert all(on_disk(view) for view in other.views.values())
    for frame, pose in one.solution.trajectory.items():
        np.testing.assert_array_equal(other.solution.trajectory[frame], pose)
    np.testing.assert_array_equal(one.model.vertices_m, other.model.vertices_m)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory as Linux tells it")
def test_memory_does_not_grow_with_the_number_of_views() -> None:
    def resident_mib() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

    store = ViewStore(memory_bytes=0, chunk_bytes=2**23)
    kept, before_mib = [], resident_mib()
    while sum(view.points_m.nbytes for view in kept) < 2**26:
        kept.append(store.keep(VIEW))
    assert resident_mib() - before_mib < 24.0
