# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The process that compiles kernels into the cache, and what asks it to.

It works in a fork that is replaced when it has grown: a compiler keeps what it has made. A lock in
the cache lets one process at a time compile, so that no kernel is compiled twice.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib
import os
import pickle
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from operator import attrgetter
from pathlib import Path
from queue import PriorityQueue
from typing import Any, NamedTuple, NoReturn

# The paths of who asks come first, so that both import the same sources.
_PROGRAM = """
import sys
from multiprocessing.connection import Connection
asked = Connection(0, writable=False)
sys.path[:] = asked.recv()
from rs_localizer.core.simd.compiler import serve
serve(asked)
"""
# Numba goes through sets of names, by whose order the same sources would round differently.
_SAME_CODE = {"PYTHONHASHSEED": "0"}
# s without a request after which the process ends; the next one starts it again.
_IDLE = 20.0
# kB from which a fork is replaced: what is Numba's own is compiled again in each, and one for all
# comes to 600 MB.
_MOST, _GROWN = 300_000, 3
_NICE = 10  # of what nobody waits for
_PR_SET_PDEATHSIG = 1  # Linux, <linux/prctl.h>
# s: kernels of other versions, in other environments, may be at work beside this one.
_KEPT = 30.0 * 86400.0
_OURS = re.compile(r"[0-9a-f]{16}")


class Request(NamedTuple):
    """A kernel and the types of its arguments, or a function that calls kernels, and its own."""

    module: str
    name: str
    arguments: tuple[Any, ...]
    is_kernel: bool = True


class _Compiler:
    """The process, which is started when there is something to do."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._orders: PriorityQueue[tuple[bool, int, Request]] | None = None
        self._ordered: set[Request] = set()
        self._failed: set[Request] = set()
        self.count = 0
        self.listeners: list[Callable[[int, str], object]] = []

    def obtain(self, request: Request) -> bool:
        with self._lock:
            self.count += 1
            for listener in self.listeners:
                listener(self.count, request.name)
            answer = None
            while answer is None:
                answer = self._ask(request)
            return answer

    def order(self, request: Request) -> bool:
        if request in self._ordered:
            return request not in self._failed
        self._ordered.add(request)
        if self._orders is None:
            self._orders = PriorityQueue()
            # Of an executor the end of the program would wait for what it is at.
            threading.Thread(target=self._follow, args=(self._orders,), daemon=True).start()
        self._orders.put((not request.is_kernel, len(self._ordered), request))
        return True

    def _follow(self, orders: PriorityQueue[tuple[bool, int, Request]]) -> NoReturn:
        while True:
            order = orders.get()
            request = order[2]
            if request.is_kernel:
                if not self.obtain(request):
                    self._failed.add(request)
                continue
            with self._lock:
                answer = self._ask(request)
            if answer is None:  # kernels that a frame has asked for since come first
                orders.put(order)

    def _ask(self, request: Request) -> bool | None:
        """The answer of the process; None: it goes on when it is asked again."""
        for _ in range(2):  # it may just have ended, for want of work
            with contextlib.suppress(OSError, EOFError):
                return self._exchange(request)
            self._end()
        return False

    def _exchange(self, request: Request) -> bool | None:
        from numba.core import serialize

        dumps: Callable[[Any], bytes] = serialize.dumps
        if self._child is None:
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=os.environ | _SAME_CODE,
            )  # fmt: skip
            assert self._child.stdin is not None
            assert self._child.stdout is not None
            self._ask_by = Connection(os.dup(self._child.stdin.fileno()), readable=False)
            self._hear_by = Connection(os.dup(self._child.stdout.fileno()), writable=False)
            self._child.stdin.close()
            self._child.stdout.close()
            self._ask_by.send(sys.path)
        self._ask_by.send_bytes(dumps(request))
        answer: bool | None = self._hear_by.recv()
        return answer

    def _end(self) -> None:
        if self._child is not None:
            self._child.terminate()
            self._child.wait()
            self._ask_by.close()
            self._hear_by.close()
            self._child = None

    def close(self) -> None:
        """End the process, whatever it is at."""
        if self._child is not None:
            self._child.terminate()
            self._child.wait()


_compiler = _Compiler()
atexit.register(lambda: _compiler.close())


def _forget() -> None:
    """In a fork: its parent's process is not its own."""
    global _compiler
    _compiler = _Compiler()


os.register_at_fork(after_in_child=_forget)


def obtain(request: Request) -> bool:
    """Have a kernel compiled into the cache, unless it is there; whether it is there now."""
    return _compiler.obtain(request)


def order(request: Request) -> bool:
    """The same without waiting for it, once; False when it could not be had so."""
    return _compiler.order(request)


@contextlib.contextmanager
def told(listener: Callable[[int, str], object]) -> Any:
    """Within ``with``, ``listener`` is told of each kernel before it is compiled.

    It takes how many this process has asked for so far, and the kernel's name.
    """
    _compiler.listeners.append(listener)
    try:
        yield
    finally:
        _compiler.listeners.remove(listener)


# -- the process itself ------------------------------------------------------------------------


def serve(asked: Connection[Any, Any]) -> None:
    """Compile what is asked for, until the asking process ends or nobody asks."""
    import numba

    from rs_localizer.core.simd import jit

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: its end is that of who asks
    njit: Any = numba.njit
    njit(lambda: 0)()  # what all have in common is done before the forks
    answers, asking = Connection(os.dup(1), readable=False), os.getppid()
    os.dup2(2, 1)
    _remove_old(jit.cache_directory())
    while True:
        if (pid := os.fork()) == 0:
            _compile_all(asked, answers)
        code = _code_of(pid, asking)
        if code == 0:
            return
        if code != _GROWN:
            answers.send(False)  # it broke off, as without memory


def _compile_all(asked: Connection[Any, Any], answers: Connection[Any, Any]) -> NoReturn:
    """In a fork: compile until nobody asks, or until it has grown."""
    from rs_localizer.core.simd import jit

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def leave_if_grown() -> None:
        # Later collections would look through all that the compiler keeps: a seventh of the work.
        gc.collect()
        gc.freeze()
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > _MOST:
            answers.send(None)
            os._exit(_GROWN)

    jit.compile_here(leave_if_grown)
    with contextlib.suppress(EOFError):
        while asked.poll(_IDLE):
            request = Request(*pickle.loads(asked.recv_bytes()))
            if request.is_kernel:
                answers.send(_kept(request))
            else:
                os.nice(_NICE)
                answers.send(_called(request))
                os._exit(_GROWN)  # there is no way back from nice
    os._exit(0)


def _code_of(pid: int, asking: int) -> int:
    """The exit code of a fork, which ends with whoever asks."""
    ended = os.pidfd_open(pid)
    while not wait([ended], 1.0):
        if os.getppid() != asking:
            os._exit(0)
    os.close(ended)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _kept(request: Request) -> bool:
    """Compile a kernel unless it is there; whether it is there now."""
    from numba.core.registry import cpu_target

    kernel = attrgetter(request.name)(importlib.import_module(request.module))
    holds = functools.partial(kernel._cache.holds, request.arguments, cpu_target.target_context)
    try:
        if not holds():
            kernel.compile(request.arguments)
        return bool(holds())
    except Exception:  # whoever asks compiles it itself, and says what is wrong
        return False


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Within ``with``, this process is the only one that compiles into the cache."""
    from rs_localizer.core.simd import jit

    jit.make_folder(jit.cache_directory())
    with (jit.cache_directory() / "rs_localizer.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _called(request: Request) -> bool:
    """Call a function that calls kernels; whether it came to its end."""
    try:
        attrgetter(request.name)(importlib.import_module(request.module))(*request.arguments)
    except Exception:  # whoever calls these kernels is told of it
        return False
    return True


def _remove_old(caches: Path) -> None:
    """Remove folders of kernels that nobody used for a month, and nothing else.

    ``NUMBA_CACHE_DIR`` is everybody's, and an empty folder may be anybody's.
    """
    with contextlib.suppress(OSError):
        for folder in caches.iterdir():
            if not _OURS.fullmatch(folder.name) or not folder.is_dir():
                continue
            names = [item.name for item in folder.iterdir()]
            ours = bool(names) and all(name.startswith("rs_localizer.") for name in names)
            if ours and folder.stat().st_mtime < time.time() - _KEPT:
                shutil.rmtree(folder, ignore_errors=True)
