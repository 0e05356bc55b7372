"""What someone measured by hand, or knows from a drawing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """One number of one sensor, in the frame and clock of the base.

    parameter: ``x``, ``y``, ``z`` (metres), ``roll``, ``pitch``, ``yaw`` (radians, ``Rz(yaw) Ry(pitch) Rx(roll)``)
    or ``dt`` (seconds, added to the sensor's stamps). sigma: one standard deviation of the value.
    """

    sensor: str
    parameter: str
    value: float
    sigma: float
