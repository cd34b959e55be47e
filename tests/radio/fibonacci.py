"""A server and a client of the action Fibonacci for tests, by the services and topics of which an action is made.

The messages are those of ``example_interfaces/action/Fibonacci``, in CDR as ROS has them.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Hashable

from gr_ros2.middleware import Qos, Subscription
from gr_ros2.middleware.services import ServiceClient, ServiceGraph, ServiceServer

FIBONACCI = "example_interfaces/action/Fibonacci"
TYPES = {
    "send_goal": f"{FIBONACCI}_SendGoal",
    "cancel_goal": "action_msgs/srv/CancelGoal",
    "get_result": f"{FIBONACCI}_GetResult",
}
FEEDBACK, STATUS = f"{FIBONACCI}_FeedbackMessage", "action_msgs/msg/GoalStatusArray"
LATCHED = Qos("reliable", "transient_local", 1)
PERIOD_S = 0.1
EXECUTING, CANCELED = 2, 5
_HEAD = b"\0\1\0\0"
_STAMP = bytes(8)


class FibonacciServer:
    """A server that gives feedback ten times a second until it is cancelled."""

    def __init__(self, graph: ServiceGraph, name: str) -> None:
        self._names = f"{name}/_action"
        self._asked = threading.Condition()
        self._waiting: Hashable = None
        self._cancelled = threading.Event()
        self.goals: list[bytes] = []
        self._feedback = graph.advertise(f"{self._names}/feedback", FEEDBACK, Qos("reliable", "volatile", 10))
        self._status = graph.advertise(f"{self._names}/status", STATUS, LATCHED)
        takers = {"send_goal": self._accept, "cancel_goal": self._cancel, "get_result": self._ask}
        self._servers: dict[str, ServiceServer] = {
            word: graph.serve(f"{self._names}/{word}", TYPES[word], take) for word, take in takers.items()
        }

    def _accept(self, client: Hashable, payload: bytes) -> None:
        self.goals.append(payload[4:20])
        self._servers["send_goal"].reply(client, _HEAD + b"\1\0\0\0" + _STAMP)
        threading.Thread(target=self._execute, args=(payload[4:20],), daemon=True).start()

    def _cancel(self, client: Hashable, payload: bytes) -> None:
        self._cancelled.set()
        goals = struct.pack("<I", 1) + payload[4:20] + _STAMP
        self._servers["cancel_goal"].reply(client, _HEAD + b"\0\0\0\0" + goals)

    def _ask(self, client: Hashable, _payload: bytes) -> None:
        with self._asked:
            self._waiting = client
            self._asked.notify()

    def _execute(self, goal: bytes) -> None:
        self._tell(goal, EXECUTING)
        numbers = [0, 1]
        while not self._cancelled.wait(PERIOD_S):
            numbers.append((numbers[-1] + numbers[-2]) % 1_000_000)
            self._feedback.publish(_HEAD + goal + sequence(numbers))
        self._tell(goal, CANCELED)
        with self._asked:
            self._asked.wait_for(lambda: self._waiting is not None)
        self._servers["get_result"].reply(self._waiting, _HEAD + struct.pack("<b3x", CANCELED) + sequence(numbers))

    def _tell(self, goal: bytes, status: int) -> None:
        self._status.publish(_HEAD + struct.pack("<I", 1) + goal + _STAMP + struct.pack("<b3x", status))


class FibonacciClient:
    """A client of one goal.

    :ivar feedback: the numbers of each message that came
    :ivar replies: by service
    :ivar statuses: of the goal, as they came
    """

    def __init__(self, graph: ServiceGraph, name: str) -> None:
        self._names = f"{name}/_action"
        self.feedback: list[list[int]] = []
        self.replies: dict[str, bytes] = {}
        self.statuses: list[int] = []
        self._there: dict[str, bool] = {}
        self._clients: dict[str, ServiceClient] = {
            word: graph.client(
                f"{self._names}/{word}",
                type_name,
                lambda _, payload, word=word: self.replies.__setitem__(word, payload),  # type: ignore[misc]
                lambda there, word=word: self._there.__setitem__(word, there),  # type: ignore[misc]
            )
            for word, type_name in TYPES.items()
        }
        self._topics: list[Subscription] = [
            graph.subscribe(f"{self._names}/feedback", FEEDBACK, Qos("reliable", "volatile", 10), self._heard),
            graph.subscribe(f"{self._names}/status", STATUS, LATCHED, self._told),
        ]

    @property
    def there(self) -> bool:
        """Whether an action server is, as rcl decides: its services and its topics."""
        services = len(self._there) == len(TYPES) and all(self._there.values())
        return services and all(topic.matched() for topic in self._topics)

    def ask(self, word: str, goal: bytes, more: bytes = b"") -> None:
        self._clients[word].call(1, _HEAD + goal + more)

    def _heard(self, payload: bytes) -> None:
        count = int.from_bytes(payload[20:24], "little")
        self.feedback.append(list(struct.unpack_from(f"<{count}i", payload, 24)))

    def _told(self, payload: bytes) -> None:
        self.statuses.append(payload[32])


def sequence(numbers: list[int]) -> bytes:
    return struct.pack(f"<I{len(numbers)}i", len(numbers), *numbers)


def statuses(graph: ServiceGraph, name: str) -> tuple[Subscription, list[int]]:
    """A program that joins late, and what it learns of the goal."""
    found: list[int] = []
    return graph.subscribe(f"{name}/_action/status", STATUS, LATCHED, lambda data: found.append(data[32])), found
