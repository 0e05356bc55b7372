"""The conformance kit: every sensor type is held to the same laws, in one line of its author's tests."""

from collections.abc import Callable, Sequence

from calib_toolkit.testing.case import SensorCase
from calib_toolkit.testing.checks import CHECKS


def parametrize_with_sensor_checks(cases: Sequence[SensorCase]) -> Callable[..., None]:
    """A pytest test of every case by every check, to be bound to a name that begins with ``test_``."""
    import pytest

    parameters = [
        pytest.param(
            case,
            check,
            id=f"{case.id}-{check.__name__}",
            marks=[pytest.mark.skip(reason=case.skip[check.__name__])] if check.__name__ in case.skip else [],
        )
        for case in cases
        for check in CHECKS
    ]

    @pytest.mark.parametrize(("case", "check"), parameters)
    def test_conformance(case: SensorCase, check: Callable[[SensorCase], None]) -> None:
        check(case)

    return test_conformance
