"""The thread that encodes the pictures of a link when the air is about to be free for them.

Invariants: nothing is encoded with the endpoint's lock held, nor on the thread that sends; the thread is there only
where a topic is sent as frames.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

from gr_ros2.codecs.frames import FrameSender, Job
from gr_ros2.core.errors import CodecError
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.link.endpoint import Endpoint

_PATIENCE_S = 1.0
"""s that closing waits for a picture that is being encoded."""


class FrameWorker:
    """Encodes what the frames of an endpoint ask for.

    :param live: the endpoint; its lock is held by whoever calls ``look``
    :param clock: s, monotonic
    """

    def __init__(
        self, sender: FrameSender, live: LiveEnd[Endpoint], clock: Callable[[], float], log: logging.Logger
    ) -> None:
        self._sender, self._live, self._clock, self._log = sender, live, clock, log
        self._work = threading.Condition(live.lock)
        self._jobs: deque[Job] = deque()
        self._running = True
        self._thread: threading.Thread | None = None
        live.look = self.look

    def look(self) -> None:
        """Find what is to be encoded now. Called with the lock held, after anything that may change it."""
        while (job := self._sender.next(self._clock())) is not None:
            self._jobs.append(job)
            if self._thread is None and self._running:
                self._thread = threading.Thread(target=self._run, name="gr-ros2-frames", daemon=True)
                self._thread.start()
            self._work.notify()

    def close(self) -> None:
        """Encode nothing more. Called without the lock."""
        with self._live.lock:
            self._running, self._live.look = False, lambda: None
            self._sender.end()
            self._work.notify()
        if self._thread is not None:
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        while True:
            with self._live.lock:
                while self._running and not self._jobs:
                    self._work.wait()
                if not self._running:
                    return
                job = self._jobs.popleft()
            try:
                made = job.run()
            except Exception as error:  # noqa: BLE001 - an exception would end all pictures
                self._log.exception("a picture was not encoded")
                made = CodecError(f"image: {error}")
            with self._live.lock:
                self._sender.done(job, made, self._clock())
                self.look()
                self._live.wake()
