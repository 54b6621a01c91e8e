"""Compiled kernels on disk: the only place that keeps them between processes.

Numba's own cache knows a kernel by its file, although functions of other files are inlined in it, reads whatever lies
there, and ends the program where nothing can be written. Here a kernel is known by the contents of all sources, the
processor and the versions that it was compiled by; each file holds a digest of the rest, and in doubt the kernel is
compiled again. Where neither the sources' folder nor the user's can be written, as on shared installations, kernels are
kept in the folder of temporary files, and where nothing can be written in memory.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import llvmlite
import llvmlite.binding
import numba
import numpy as np
from numba.core.caching import _Cache  # pyright: ignore[reportPrivateUsage]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

with suppress(AttributeError):  # each call of LLVM is announced, 200 a kernel, to nobody
    llvmlite.binding.ffi.lib._lock._cblist.clear()

_HERE: Final = Path(__file__).parent
_DIGEST_BYTES: Final = 32
_MOST_BYTES: Final = 1 << 26  # of a file
_ALL_BYTES: Final = 1 << 24  # of all files together, with room to spare
_STALE_S: Final = 7 * 86400.0  # since a kernel was added
_SETTINGS: Final = ("NUM_THREADS", "THREADING_LAYER", "THREADING_LAYER_PRIORITY", "CACHE_DIR")
"""Settings of Numba that do not change the code that it compiles."""


def njit(function: Callable[..., Any] | None = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile a function as `numba.njit` does; with `cache`, keep the result here."""
    if function is None:
        return lambda function: njit(function, cache=cache, **options)
    kernel: Any = numba.njit(**options)(function)
    if cache:
        kernel._cache = KernelCache(function)
    return kernel


def folder() -> Path:
    """Return the folder in which kernels are kept first of all."""
    return next(_folders())


def writable() -> Path | None:
    """Return the folder in which kernels will be kept; None if there is none."""
    for folder in _folders():
        probe = folder / f"room-{os.getpid()}"
        if _written(probe, bytes(_ALL_BYTES)):
            probe.unlink(missing_ok=True)
            return folder
    return None


def kept(module: str, name: str) -> bool:
    """Return whether a kernel is kept on disk, whole and of the current sources."""
    return any(_content(path) is not None for folder in _folders() for path in folder.glob(f"{module}.{name}-*"))


class KernelCache(_Cache):
    """The files of one kernel, one for each signature, named by everything that the compiled code depends on."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Take the function that is compiled."""
        self._name = f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"
        cells = tuple(cell.cell_contents for cell in function.__closure__ or ())
        self._closure = dumps(cells) if cells else b""

    @property
    def cache_path(self) -> Any:
        """The folder in which it is kept first of all."""
        return str(folder())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code for a signature; None if there is none that can be relied on."""
        rtsys.initialize(target_context)  # all that code needs; what a compilation looks up takes 0.2 s to import
        codegen = target_context.codegen()
        codegen._library_class, name = _Library, self._file_name(sig, codegen)
        for folder in _folders():
            content = _content(folder / name)
            if content is not None:
                with suppress(Exception):  # whatever is wrong with it, it can be compiled
                    return CompileResult._rebuild(target_context, *pickle.loads(content))
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, in the first folder that takes it."""
        if data.library.has_dynamic_globals or any(not lifted.can_cache for lifted in data.lifted):
            return
        *parts, environments = data._reduce()
        # Empty ones are of Numba's own functions, of which loading would import the modules.
        content = dumps((*parts, [environment for environment in environments if environment.consts]))
        name = self._file_name(sig, data.codegen)
        for folder in _folders():
            if _written(folder / name, hashlib.sha256(content).digest() + content):
                return

    def enable(self) -> None:
        """Do nothing: it is always enabled."""

    def disable(self) -> None:
        """Do nothing."""

    def flush(self) -> None:
        """Do nothing: what is kept never becomes stale."""

    def _file_name(self, sig: Any, codegen: Any) -> str:
        key = repr((sig, codegen.magic_tuple())).encode() + self._closure
        return f"{self._name}-{hashlib.sha256(key).hexdigest()[:16]}"


class _Library(JITCodeLibrary):
    """Compiled code, of whose intermediate form nothing is read from the cache before another kernel inlines it.

    Numba parses it, and asks LLVM for each of its names, which takes more than half of the time of loading a kernel.
    """

    _unread: bytes = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> _Library:
        name, _, (code, unread) = state
        library = codegen.create_library(name)
        library._unread = unread
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        return library

    def _get_module_for_linking(self) -> Any:
        if self._unread:
            self._shared_module, self._unread = llvmlite.binding.parse_bitcode(self._unread), b""
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return super()._get_module_for_linking()

    def get_pointer_to_function(self, name: str) -> int:
        engine = self._codegen._engine
        return engine.get_function_address(name) if self._unread else super().get_pointer_to_function(name)


def _folders() -> Iterator[Path]:
    """Yield where kernels are read and written, in this order.

    Where Numba's setting says or the sources are, the user's folder for such files, and that of temporary files.
    """
    name, own = f"kernels-{_MACHINE}-{_SOURCES}", os.environ.get("NUMBA_CACHE_DIR")
    yield (Path(own).absolute() if own else _HERE / "__pycache__") / name
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(user):
        yield Path(user) / "modeler" / name
    temporary = Path(os.environ.get("TMPDIR") or "/tmp") / f"modeler-{os.geteuid()}"
    if temporary.is_absolute() and _is_private(temporary):
        yield temporary / name


def _is_private(place: Path) -> bool:
    """Return whether a folder, which anybody may make beforehand, is nobody else's."""
    try:
        status = place.lstat()
    except OSError:  # it is not there yet
        return True
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _digest(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _machine() -> str:
    """Return a digest of where and by what kernels are compiled."""
    settings = sorted((k, v) for k, v in os.environ.items() if k.startswith("NUMBA_") and k[6:] not in _SETTINGS)
    versions = (sys.version, sys.flags.optimize, numba.__version__, llvmlite.__version__, np.__version__)
    processor = (llvmlite.binding.get_host_cpu_name(), llvmlite.binding.get_host_cpu_features().flatten())
    return _digest(str(_HERE), platform.machine(), processor, versions, settings)


_SOURCES: Final = _digest(*((path.name, path.read_bytes()) for path in sorted(_HERE.glob("*.py"))))
_MACHINE: Final = _machine()


def _content(path: Path) -> bytes | None:
    """Return what a file holds; None unless it is whole, a regular file, and of somebody who may change the sources."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            trusted = status.st_uid in (0, os.geteuid(), os.stat(__file__).st_uid) and not status.st_mode & 0o022
            if not (stat.S_ISREG(status.st_mode) and status.st_size <= _MOST_BYTES and trusted):
                return None
            data = file.read(_MOST_BYTES)
    except OSError:
        return None
    content = data[_DIGEST_BYTES:]
    return content if hashlib.sha256(content).digest() == data[:_DIGEST_BYTES] else None


def _written(path: Path, data: bytes) -> bool:
    """Replace a file atomically, and return whether that was possible."""
    part = None
    try:
        if not path.parent.is_dir():
            path.parent.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
            path.parent.mkdir(mode=0o755, exist_ok=True)
            for stale in _stale(path.parent):
                shutil.rmtree(stale, ignore_errors=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            part = file.name
            file.write(data)
            os.fchmod(file.fileno(), 0o644)  # others may use it, and nobody else write it
        os.replace(part, path)
    except OSError:
        if part is not None:
            with suppress(OSError):
                os.unlink(part)
        return False
    return True


def _stale(folder: Path) -> Iterator[Path]:
    """Yield the folders of kernels that this machine compiled from other contents of the same sources, long ago.

    A process that began with those may still add to them.
    """
    long_ago_s = time.time() - _STALE_S
    yield from (
        other
        for other in folder.parent.glob(f"kernels-{_MACHINE}-*")
        if other != folder and other.stat().st_mtime < long_ago_s
    )
