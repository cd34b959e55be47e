"""Fast DDS, the distribution's, for the race: its C++ library behind a few functions (fastdds.cpp), compiled once.

Invariants: what Python gives to Fast DDS lives until the participant has left. Messages are opaque bytes.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import os
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import BackendMissingError, MiddlewareError
from gr_ros2.middleware import Publisher, Qos, Subscription, ros_graph
from gr_ros2.middleware.base import MessageCallback

_SOURCE, _HEADER = (Path(__file__).with_name(name) for name in ("fastdds.cpp", "fastdds_opaque.hpp"))
_HEADERS = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
_THIRD = Path("/usr/include/fastdds/config.hpp")
"""Fast DDS 3 has it; before, its library was called fastrtps."""
_REMEDY = "apt install g++ and libfastdds-dev or libfastrtps-dev, or race other --peers"
_TAKE = ctypes.CFUNCTYPE(None, ctypes.POINTER(ctypes.c_ubyte), ctypes.c_size_t)


def has_fast_dds() -> bool:
    """Whether Fast DDS's headers and a compiler are here."""
    return _HEADERS.exists() and shutil.which("g++") is not None


def library() -> Path:
    """The compiled functions, in the user's cache.

    :raises BackendMissingError: where they cannot be compiled
    """
    if not has_fast_dds():
        raise BackendMissingError(f"Fast DDS is not installed: {_REMEDY}")
    options = ("-std=c++17", "-O1", "-shared", "-fPIC")
    linked = ("-lfastdds" if _THIRD.exists() else "-lfastrtps", "-lfastcdr")
    text = _SOURCE.read_bytes() + _HEADER.read_bytes() + repr((options, linked, sysconfig.get_platform())).encode()
    cache = Path(os.environ.get("XDG_CACHE_HOME", "") or Path.home() / ".cache") / "gr-ros2"
    cache.mkdir(parents=True, exist_ok=True)
    made = cache / f"fastdds-{hashlib.sha256(text).hexdigest()[:16]}.so"
    with made.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            part = made.with_suffix(".part")
            command = ["g++", *options, "-o", str(part), str(_SOURCE), *linked]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise BackendMissingError(f"Fast DDS does not compile ({done.stderr.strip()[:200]}): {_REMEDY}")
            part.replace(made)
    return made


class FastDds(Closing):
    """One participant.

    :param profiles: XML with the profiles ``race``, ``race_writer`` and ``race_reader``
    :raises MiddlewareError: when it cannot join
    """

    def __init__(self, domain_id: int, profiles: str) -> None:
        self._library = ctypes.CDLL(str(library()))
        for name in ("fast_join", "fast_writer", "fast_reader"):
            getattr(self._library, name).restype = ctypes.c_void_p
        self._kept: list[Any] = []
        self._network = self._library.fast_join(domain_id, profiles.encode())
        if not self._network:
            raise MiddlewareError("Fast DDS does not join: its profiles or its network are wrong")

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        """Create a publisher."""
        return _FastPublisher(self._library, self._endpoint("writer", topic, type_name, qos))

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        """Create a subscription."""

        def take(data: Any, length: int) -> None:
            callback(ctypes.string_at(data, length))

        taker = _TAKE(take)
        self._kept.append(taker)
        return _FastSubscription(self._library, self._endpoint("reader", topic, type_name, qos, taker))

    def _endpoint(self, kind: str, topic: str, type_name: str, qos: Qos, *more: Any) -> int:
        names = ros_graph.dds_topic(topic).encode(), ros_graph.dds_type(type_name).encode()
        how = int(qos.reliability == "reliable"), int(qos.durability == "transient_local"), qos.depth
        made = getattr(self._library, f"fast_{kind}")(ctypes.c_void_p(self._network), *names, *how, *more)
        if not made:
            raise MiddlewareError(f"Fast DDS: no {kind} of {topic}")
        return int(made)

    def close(self) -> None:
        """Leave. Idempotent."""
        if self._network:
            self._library.fast_leave(ctypes.c_void_p(self._network))
            self._network = None


class _FastPublisher(Publisher):
    def __init__(self, functions: ctypes.CDLL, writer: int) -> None:
        self._functions, self._writer = functions, ctypes.c_void_p(writer)

    def publish(self, payload: bytes) -> None:
        self._functions.fast_write(self._writer, payload, ctypes.c_size_t(len(payload)))

    def matched(self) -> int:
        """Readers found."""
        return int(self._functions.fast_writer_matched(self._writer))

    def close(self) -> None:
        """Do nothing: it goes with its participant."""


class _FastSubscription(Subscription):
    def __init__(self, functions: ctypes.CDLL, reader: int) -> None:
        super().__init__()
        self._functions, self._reader = functions, ctypes.c_void_p(reader)

    def matched(self) -> int:
        """Writers found."""
        return int(self._functions.fast_reader_matched(self._reader))

    def close(self) -> None:
        """Do nothing: it goes with its participant."""
