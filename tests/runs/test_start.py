import os
import platform
import subprocess
import sys
import types

import pytest

from cmedirl_jax.runs import start
from cmedirl_jax.runs.cluster.base import ClusterOptions
from cmedirl_jax.runs.errors import UserError

# Eight threads that allocate at the same time, each from the arena that it was given.
SCRIPT = """
import ctypes, re, sys, tempfile, threading
from cmedirl_jax.runs import start
from cmedirl_jax.runs.cluster.base import ClusterOptions
from cmedirl_jax.runs.errors import UserError

if sys.argv[1:]:
    start.share_heap(arenas=int(sys.argv[1]))
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.fdopen.restype = ctypes.c_void_p
met = threading.Barrier(8)

def allocate():
    met.wait()
    libc.malloc(1_000)
    met.wait()

threads = [threading.Thread(target=allocate) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
with tempfile.TemporaryFile() as file:
    stream = ctypes.c_void_p(libc.fdopen(file.fileno(), b"w"))
    libc.malloc_info(0, stream)
    libc.fflush(stream)
    file.seek(0)
    print(len(re.findall(b"<heap nr=", file.read())))
"""


def arenas(*arguments, **environment):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments],
        env={**{k: v for k, v in os.environ.items() if k != "MALLOC_ARENA_MAX"}, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are glibc's")
def test_threads_share_the_arenas_that_there_may_be():
    assert arenas() > 3
    assert arenas("1") == 1
    assert arenas("3") == 3


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are glibc's")
def test_what_the_user_says_stays():
    assert arenas("1", MALLOC_ARENA_MAX="3") == 3


@pytest.mark.parametrize("system", ["linux", "darwin"])
def test_another_c_library_is_left_alone(system, monkeypatch):
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    monkeypatch.setattr(start.sys, "platform", system)
    monkeypatch.setattr(start.ctypes, "CDLL", lambda _: object())
    start.share_heap(arenas=2)


def test_a_core_is_for_as_many_seeds_as_are_asked(monkeypatch):
    devices = []

    def refuse(_):
        raise UserError("enough")

    monkeypatch.setattr(start, "cores", lambda: 64)
    monkeypatch.setattr(start, "share_heap", lambda arenas: None)
    monkeypatch.setattr(start.jax.config, "update", lambda _, count: devices.append(count))
    monkeypatch.setattr(start.processes, "join", refuse)
    for seeds, fewest in ((100, 4), (100, 32), (1_000, 4), (3, 4)):
        with pytest.raises(UserError, match="enough"):
            start.start(ClusterOptions(), None, seeds, {}, fewest)
    assert devices == [25, 3, 64, 1]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (AssertionError(), "it is not installed, or has no device"),
        (RuntimeError("Unable to initialize\nbackend 'cuda'"), "Unable to initialize backend "),
    ],
)
@pytest.mark.parametrize(
    ("asked", "beginning"),
    [
        ("cuda", "JAX_PLATFORMS=cuda: JAX finds no such platform here ("),
        ("", "JAX cannot start here: "),
    ],
)
def test_a_platform_that_is_not_here_is_refused(monkeypatch, asked, beginning, error, reason):
    def local_devices():
        raise error

    monkeypatch.setattr(start.jax, "local_devices", local_devices)
    config = types.SimpleNamespace(jax_platforms=asked, update=lambda *_: None)
    monkeypatch.setattr(start.jax, "config", config)
    with pytest.raises(UserError) as refusal:
        start.start(ClusterOptions(), None, 1, {})
    line = str(refusal.value)
    assert line.startswith(beginning + reason)
    assert "\n" not in line
