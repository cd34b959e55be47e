"""Who receives what, when, and at which SNR: the medium between robots, at packets or at samples."""

from gr_ros2.medium.base import Medium, Path, Reception, Transmission
from gr_ros2.medium.choice import make_medium

__all__ = ["Medium", "Path", "Reception", "Transmission", "make_medium"]
