"""What tests of flowgraphs share: a block that posts and collects PDUs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pmt
from gnuradio import gr

from gr_ros2.link import ReceiverEvent, SenderEvent
from gr_ros2.phy.pdus import credited


class Hears:
    """A LinkObserver that hands every event to one function."""

    def __init__(self, hear: Callable[[Any], object]) -> None:
        self._hear = hear

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002
        self._hear(event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self._hear(event)


def pdu(data: bytes) -> Any:
    return pmt.cons(pmt.make_dict(), pmt.init_u8vector(len(data), list(data)))


class Probe(gr.basic_block):
    """Posts on `pdus`, collects what comes in on `pdus` and adds up what `credit` brings."""

    def __init__(self) -> None:
        super().__init__("probe", None, None)
        for name in ("pdus", "credit"):
            self.message_port_register_in(pmt.intern(name))
        self.message_port_register_out(pmt.intern("pdus"))
        self.message_port_register_out(pmt.intern("credit"))
        self.set_msg_handler(pmt.intern("pdus"), self._collect)
        self.set_msg_handler(pmt.intern("credit"), self._count)
        self.messages: list[Any] = []
        self.times: list[float] = []
        self.handled = self.emitted = 0
        self.credits = 0
        self.granted: list[Any] = []
        self.uses_credit = False

    def use_credit(self) -> None:
        self.uses_credit = True

    def post(self, data: bytes) -> None:
        self.post_message(pdu(data))

    def post_message(self, message: Any) -> None:
        self.emitted += 1
        self.message_port_pub(pmt.intern("pdus"), message)

    @property
    def packets(self) -> list[bytes]:
        return [bytes(pmt.u8vector_elements(pmt.cdr(message))) for message in self.messages]

    def _collect(self, message: Any) -> None:
        self.times.append(time.monotonic())
        self.messages.append(message)
        self.handled += 1

    def _count(self, message: Any) -> None:
        self.granted.append(message)
        self.credits += credited(message)[0]
