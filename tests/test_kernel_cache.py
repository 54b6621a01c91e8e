"""Kernels kept between processes are current and whole, or compiled again."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runner import spawned
from slow_cases import quick_first

from modeler import kernels
from modeler.cli.console import say
from modeler.kernels import cache
from modeler.runs import compiling

_INNER = "from toy.cache import njit\n\n\n@njit(cache=True, inline='always')\ndef inner(x):\n    return x + {}\n"
_OUTER = """\
from toy.cache import njit
from toy.inner import inner

@njit(cache=True)
def outer(x):
    return inner(x)
"""
_CALL = """\
from numba.core import event
with event.install_recorder("numba:compile") as recorder:
    from toy import cache
    from toy.outer import outer
    print(outer(1.0), len(recorder.buffer), cache.kept("outer", "outer"), cache.writable() is not None)
"""


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """Return a folder with a package of two kernels, of which one is inlined in the other, and the cache."""
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "__init__.py").touch()
    shutil.copy(str(cache.__file__), tmp_path / "toy" / "cache.py")
    (tmp_path / "toy" / "inner.py").write_text(_INNER.format(1))
    (tmp_path / "toy" / "outer.py").write_text(_OUTER)
    return tmp_path


def called(toy: Path, **settings: str) -> list[str]:
    """Return the result in a process of its own, the number of events of compiling, and the state of the cache."""
    places = {"HOME": str(toy / "home"), "TMPDIR": str(toy / "temporary")}
    # Sources of equal times and sizes are equal to Python itself, where it has written bytecode.
    python = {"PYTHONPATH": str(toy), "PYTHONDONTWRITEBYTECODE": "1"}
    ended = spawned("-c", _CALL, settings=python | places | settings, timeout=100.0)
    assert (ended.status, ended.err) == (0, "")
    return ended.out.split()


def files(toy: Path) -> list[Path]:
    return [path for path in toy.rglob("kernels-*/*") if path.is_file()]


def test_a_kernel_is_compiled_once_under_each_settings(toy: Path) -> None:
    first, second, other = called(toy), called(toy), called(toy, NUMBA_OPT="1")
    assert first[0] == second[0] == "2.0"
    assert min(int(first[1]), int(other[1])) > int(second[1]) == 0
    assert second[2:] == ["True", "True"]
    assert not list(toy.glob("home/**/kernels-*"))


@pytest.mark.parametrize("own", quick_first([True, False]))
def test_a_kernel_is_compiled_again_once_a_function_inlined_in_it_has_changed(toy: Path, own: bool) -> None:
    settings = {"NUMBA_CACHE_DIR": str(toy / "elsewhere")} if own else {}
    assert called(toy, **settings)[0] == "2.0"
    times, kept = os.stat(toy / "toy" / "inner.py"), files(toy)
    (toy / "toy" / "inner.py").write_text(_INNER.format(5))
    os.utime(toy / "toy" / "inner.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert called(toy, **settings)[0] == "6.0"
    assert bool(list(toy.glob("elsewhere/kernels-*"))) == own
    (before,) = {path.parent for path in kept}
    assert len({path.parent for path in files(toy)}) == 2  # a process that began earlier may use the others
    os.utime(before, (10, 10))
    (toy / "toy" / "inner.py").write_text(_INNER.format(7))
    assert called(toy, **settings)[0] == "8.0"
    assert not before.exists()


def test_a_kernel_from_the_cache_is_linked_with_one_that_is_compiled(toy: Path) -> None:
    (toy / "toy" / "inner.py").write_text(_INNER.format(1).replace(", inline='always'", ""))
    called(toy)
    (outer,) = (path for path in files(toy) if path.name.startswith("outer."))
    outer.unlink()
    first, compiled, *_ = called(toy)
    assert first == "2.0"
    assert int(compiled) > 0


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "fifo": fifo,
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "flipped": flip,
    "writable by others": lambda path: path.chmod(0o666),
}


@pytest.mark.parametrize("damage", quick_first(DAMAGES))
def test_damaged_kernels_are_compiled_again(toy: Path, damage: str) -> None:
    called(toy)
    whole = {path: path.read_bytes() for path in files(toy)}
    assert whole
    for path in whole:
        DAMAGES[damage](path)
    assert called(toy)[0] == "2.0"
    assert {path.name for path in files(toy)} == {path.name for path in whole}
    assert int(called(toy)[1]) == 0


@pytest.mark.parametrize("place", quick_first(["/dev/null/kernels", "/proc/kernels"]))
def test_where_nothing_can_be_written_kernels_stay_in_memory(toy: Path, place: str) -> None:
    assert called(toy, NUMBA_CACHE_DIR=place, HOME=place, TMPDIR=place)[::3] == ["2.0", "False"]
    assert not files(toy)


def test_where_neither_installation_nor_home_can_be_written_kernels_are_temporary(toy: Path) -> None:
    first = called(toy, NUMBA_CACHE_DIR="/proc/kernels", HOME="/proc/home")
    assert first[::3] == ["2.0", "True"]
    assert int(first[1]) > 0
    assert {path.parents[1] for path in files(toy)} == {toy / "temporary" / f"modeler-{os.geteuid()}"}
    assert int(called(toy, NUMBA_CACHE_DIR="/proc/kernels", HOME="/proc/home")[1]) == 0
    (toy / "temporary" / f"modeler-{os.geteuid()}").chmod(0o777)  # as if of somebody else
    assert int(called(toy, NUMBA_CACHE_DIR="/proc/kernels", HOME="/proc/home")[1]) > 0


def test_a_home_in_the_current_folder_is_none(toy: Path) -> None:
    called(toy, NUMBA_CACHE_DIR="/dev/null/kernels", HOME="", XDG_CACHE_HOME="", TMPDIR="here")
    assert not files(toy)


def test_that_kernels_cannot_be_kept_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cache, "kept", lambda module, name: False)
    monkeypatch.setattr(cache, "writable", lambda: None)
    reports: list[Callable[[str], None]] = []
    monkeypatch.setattr(kernels, "on_compiling", reports.append)
    compiling.compile_kernels(say)
    assert capsys.readouterr().err.startswith(f"modeler: compiled kernels cannot be kept in {cache.folder()}")
    reports[0]("tsdf")
    assert "compiling kernels, for this command alone: 1 of" in capsys.readouterr().err


def test_that_kernels_are_kept_elsewhere_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(cache, "kept", lambda module, name: False)
    monkeypatch.setattr(cache, "writable", lambda: tmp_path)
    monkeypatch.setattr(compiling, "_JOBS", {})
    compiling.compile_kernels(say)
    assert capsys.readouterr().err == ""  # nothing is missing
    monkeypatch.setattr(compiling, "_JOBS", {"nothing": compiling._Job(lambda: None, ("tsdf", "_observe"))})
    compiling.compile_kernels(say)
    given = capsys.readouterr().err.splitlines()
    assert given[0] == f"modeler: compiled kernels are kept in {tmp_path}, as {cache.folder()} cannot be written"
