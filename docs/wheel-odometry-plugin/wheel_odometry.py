"""Wheel odometry: the motion of a vehicle's rear axle from its speed and yaw rate."""

from dataclasses import dataclass

import numpy as np

from calib_toolkit import DataError, Log, Motions, Sensor, SensorTable, Stream, hookimpl, tables


@dataclass(frozen=True)
class WheelOptions:
    """One sigma of speed (m/s), yaw rate (rad/s), and of what wheels do not see: slip and heave, roll and pitch."""

    sigma_speed: float = 0.05
    sigma_yaw_rate: float = 0.005
    sigma_slip: float = 0.05
    sigma_tilt: float = 0.03


def estimate(stream: Stream, options: WheelOptions) -> Motions:
    """An arc from each reading, ``(speed, yaw rate)``, to the next. Raises DataError."""
    if len(stream) < 2:
        raise DataError(f"sensor {stream.name}: a motion takes two readings, and there is {len(stream)}")
    rates = np.array([stream.readings[i] for i in range(len(stream))], dtype=float)
    if not np.isfinite(rates).all():
        bad = stream.stamps[~np.isfinite(rates).all(axis=1)][0]
        raise DataError(f"sensor {stream.name}: its rates at {bad:.3f} s are not numbers; remove that line")
    dt = np.diff(stream.stamps)
    distance, yaw = dt * (rates[1:] + rates[:-1]).T / 2
    vec = np.zeros((len(dt), 6))
    chord = distance * np.sinc(yaw / (2 * np.pi))
    vec[:, 0], vec[:, 1], vec[:, 5] = chord * np.cos(yaw / 2), chord * np.sin(yaw / 2), yaw
    slip, tilt = options.sigma_slip, options.sigma_tilt
    sigma = np.array([options.sigma_speed, slip, slip, tilt, tilt, options.sigma_yaw_rate])
    return Motions(stream.stamps[:-1], stream.stamps[1:], vec, dt[:, None, None] ** 2 * np.diag(sigma**2))


def open_table(table: SensorTable) -> Log:
    """``rates = FILE.csv``: a line of titles, then ``stamp,speed,yaw_rate``: s, m/s, rad/s. Raises DataError."""
    tables.refuse_unknown(table, ["rates"])
    file = tables.table_file(table, "rates")
    _, *rows = tables.read_rows(file, 3, 3, titles=True)
    ns, numbers = tables.to_nanoseconds(rows), tables.to_numbers(rows, 3)
    keep, notes = tables.usable_rows(ns, numbers, rows)
    stamps, epoch_ns = tables.seconds(ns[keep], ns[keep[0]]), int(ns[keep[0]])
    stream = Stream(table.name, "wheel_odometry", stamps, list(numbers[keep, 1:]), notes=notes)
    return Log(file, {table.name: stream}, epoch_ns)


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """What calib-toolkit calls to learn of this sensor."""
    return [Sensor("wheel_odometry", estimate, WheelOptions, open_table)]
