"""The laws of a sensor type, one function each; a check fails with a sentence for the plugin's author."""

import pickle
from collections.abc import Callable

import joblib
import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import CalibrationError
from calib_toolkit.testing.case import SensorCase
from calib_toolkit.testing.drives import FORWARD, STILL, TURNING
from calib_toolkit.types import Motions, Trajectory

Array = NDArray[np.float64]


def stamps_increase(case: SensorCase) -> None:
    """Every motion ends after it starts, within the stream, no motion starts before the one listed before it."""
    stream, m = case.stream(TURNING), case.measured(TURNING)
    assert len(m) >= len(stream) // 2, f"{len(m)} motions from {len(stream)} readings of an easy drive"
    assert np.all(np.isfinite(m.vec)), "a motion holds nan or inf; leave failed motions out"
    assert np.all(m.end > m.start), "a motion ends before it starts"
    assert np.all(np.diff(m.start) >= 0.0), "motions are not in order of time"
    slack = stream.period
    assert m.start[0] >= stream.stamps[0] - slack, "a motion starts before the first reading"
    assert m.end[-1] <= stream.stamps[-1] + slack, "a motion ends after the last reading"


def covariances_are_positive(case: SensorCase) -> None:
    """Covariances are symmetric and positive: definite, or semidefinite along a translation without scale."""
    for drive in (STILL, FORWARD, TURNING):
        found, motions = case.found(drive), case.measured(drive)
        parts = [motions.cov, found.cov, found.drift] if isinstance(found, Trajectory) else [motions.cov]
        for cov in parts:
            assert np.allclose(cov, np.swapaxes(cov, 1, 2), rtol=1e-6, atol=1e-15), f"{drive.name}: not symmetric"
            least, most = np.linalg.eigvalsh(cov)[:, [0, -1]].T
            assert np.all(least >= -1e-9 * most), f"{drive.name}: a covariance has a negative eigenvalue"
        rank = np.linalg.matrix_rank(motions.cov, hermitian=True)
        assert np.all(rank >= 5 + motions.has_scale), f"{drive.name}: a motion is claimed to be known without error"


def still_rig_gives_identity(case: SensorCase) -> None:
    """At rest there is no rotation, and no translation (of which a sensor without scale can tell nothing)."""
    m = case.measured(STILL)
    if not len(m):
        assert not case.measured(FORWARD).has_scale, "a rig at rest is measurable, and no motion was returned"
        return
    shift, turn = case.still
    middle = np.abs(np.median(m.vec, axis=0))
    assert np.all(middle[3:] <= turn), f"at rest it turns by {middle[3:]} rad a step"
    assert not m.has_scale or np.all(middle[:3] <= shift), f"at rest it moves by {middle[:3]} m a step"


def forward_drive_has_the_right_sign(case: SensorCase) -> None:
    """Translation regressed on the truth has slope one: not minus one (inverse motion), not 1000 (millimetres)."""
    m = case.measured(FORWARD)
    slope = _slope(m.vec[:, :3], case.truth(FORWARD, m)[:, :3])
    assert abs(slope - 1.0) <= case.slope, f"translation is {slope:.3f} times the true one; T_prev_curr in metres?"


def turning_drive_has_the_right_sign(case: SensorCase) -> None:
    """Rotation regressed on the truth has slope one: not minus one (inverse motion), not 57 (degrees)."""
    m = case.measured(TURNING)
    slope = _slope(m.vec[:, 3:], case.truth(TURNING, m)[:, 3:])
    assert abs(slope - 1.0) <= case.slope, f"rotation is {slope:.3f} times the true one; T_prev_curr in radians?"


def errors_match_the_covariance(case: SensorCase) -> None:
    """The mean squared error, whitened by the claimed covariance, is near one per degree of freedom."""
    m = case.measured(TURNING)
    basis = _basis(case.truth(TURNING, m), m)
    error = np.einsum("nij,ni->nj", basis, m.vec - case.truth(TURNING, m))
    cov = np.swapaxes(basis, 1, 2) @ m.cov @ basis
    nees = float(np.mean(np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])))
    low, high = case.nees
    assert low <= nees / error.shape[1] <= high, (
        f"squared errors are {nees / error.shape[1]:.2f} times what the covariance claims; "
        f"this case allows {low} to {high}"
    )


def scale_free_translations_are_unit(case: SensorCase) -> None:
    """Where the length is unknown it is one, and where it is known it is not always one."""
    m = case.measured(TURNING)
    length = np.linalg.norm(m.vec[:, :3], axis=1)
    if m.has_scale:
        assert not np.allclose(length, 1.0), "every translation is of length one; set has_scale=False"
    else:
        assert np.allclose(length, 1.0, atol=1e-6), "a sensor without scale must return unit translations"


def same_input_same_answer(case: SensorCase) -> None:
    """Two calls give the same numbers, to the last bit: seed what is random."""
    assert _equal(case.estimate(case.stream(TURNING)), case.found(TURNING))


def inputs_are_left_alone(case: SensorCase) -> None:
    """The stream, its readings and the options are after the call what they were before."""
    stream = case.stream(TURNING)
    before = joblib.hash((stream, case.options))
    case.estimate(stream)
    assert joblib.hash((stream, case.options)) == before, "estimate changed its stream or its options"


def slices_join_to_the_whole(case: SensorCase) -> None:
    """Slices that share one reading give what the whole gives, but for the noise of the estimate: two of its claimed
    sigmas, times the root of the most that ``case.nees`` allows."""
    stream, whole = case.stream(TURNING), case.measured(TURNING)
    third = max(len(stream) // 3, 1)
    cuts = range(0, len(stream) - 1, third)
    found = [case.estimate(stream[i : i + third + 1]) for i in cuts if len(stream[i : i + third + 1]) > 1]
    if all(isinstance(f, Trajectory) for f in found):
        joined = Trajectory.concatenate([f for f in found if isinstance(f, Trajectory)]).motions()
    else:
        joined = Motions.concatenate([f for f in found if isinstance(f, Motions)])
    assert np.array_equal(joined.start, whole.start), "slices do not give the motions that the whole gives"
    assert np.array_equal(joined.end, whole.end), "slices do not give the motions that the whole gives"
    sigma = np.sqrt(case.nees[1] * np.diagonal(whole.cov, axis1=1, axis2=2))
    assert np.all(np.abs(joined.vec - whole.vec) <= 2 * sigma + 1e-9), "a motion depends on where the stream was cut"


def survives_pickling(case: SensorCase) -> None:
    """Estimate, options and stream can be sent to another process: module-level functions, no open files."""
    estimate, options, stream = pickle.loads(
        pickle.dumps((case.sensor.estimate, case.options or case.sensor.options(), case.stream(TURNING)))
    )
    assert estimate is case.sensor.estimate
    assert type(options)() is not None
    assert _equal(case.estimate(stream), case.found(TURNING))


def one_reading_is_refused(case: SensorCase) -> None:
    """A single reading is no motion: a CalibrationError that names the sensor, not a traceback."""
    stream = case.stream(TURNING)[:1]
    try:
        case.estimate(stream)
    except CalibrationError as e:
        said = str(e)
    else:
        raise AssertionError("one reading was accepted; raise DataError with a sentence")
    assert stream.name in said, f"the refusal does not name the sensor {stream.name}: {said}"


CHECKS: tuple[Callable[[SensorCase], None], ...] = (
    stamps_increase,
    covariances_are_positive,
    still_rig_gives_identity,
    forward_drive_has_the_right_sign,
    turning_drive_has_the_right_sign,
    errors_match_the_covariance,
    scale_free_translations_are_unit,
    same_input_same_answer,
    inputs_are_left_alone,
    slices_join_to_the_whole,
    survives_pickling,
    one_reading_is_refused,
)
"""Every check, in the order in which they are run."""


def _slope(measured: Array, truth: Array) -> float:
    return float(np.sum(measured * truth) / np.sum(truth * truth))


def _basis(truth: Array, motions: Motions) -> Array:
    """(n, 6, 6) or, where only the direction of the translation is known, (n, 6, 5): what can be compared."""
    n = len(truth)
    if motions.has_scale:
        return np.tile(np.eye(6), (n, 1, 1))
    basis = np.zeros((n, 6, 5))
    basis[:, 3:, 2:] = np.eye(3)
    basis[:, :3, :2] = np.linalg.svd(truth[:, None, :3])[2][:, 1:].swapaxes(1, 2)
    return basis


def _equal(a: Motions | Trajectory, b: Motions | Trajectory) -> bool:
    return type(a) is type(b) and all(np.array_equal(vars(a)[field], vars(b)[field]) for field in vars(a))
