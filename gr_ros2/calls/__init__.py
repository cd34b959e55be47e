"""Calls of services across a link: requests to one robot, and the replies to those who asked."""

from gr_ros2.calls.engine import Answer, Calls, Offer, OutgoingFrame, Request, Service
from gr_ros2.calls.frames import NO_DEADLINE

__all__ = ["NO_DEADLINE", "Answer", "Calls", "Offer", "OutgoingFrame", "Request", "Service"]
