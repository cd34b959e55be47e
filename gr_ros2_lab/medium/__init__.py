"""Who receives what, when, and at which SNR: the medium between robots, at packets or at samples."""

from gr_ros2_lab.medium.base import FixedPaths, Medium, RadioPath, Reception, Surroundings, Transmission
from gr_ros2_lab.medium.choice import make_medium

__all__ = ["FixedPaths", "Medium", "RadioPath", "Reception", "Surroundings", "Transmission", "make_medium"]
