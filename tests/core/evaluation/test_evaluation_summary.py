"""What a table is summed up to, beside the numbers of the paper."""

import numpy as np
from recorded_drives import rows_of

from calib_toolkit.evaluation import summary
from calib_toolkit.evaluation.paper import beside
from calib_toolkit.evaluation.protocols import PROTOCOLS

# ---- protocols


def test_the_papers_lengths_and_spreads_are_the_defaults():
    assert PROTOCOLS["timing"].seconds == tuple(range(10, 201, 10))
    assert PROTOCOLS["timing"].spreads == (0.1, 1.0)
    assert PROTOCOLS["pair"].seconds == tuple(range(10, 301, 10))
    assert PROTOCOLS["panoramic"].seconds == (30,)


def test_the_papers_numbers_stand_where_they_belong():
    assert beside("timing", "dt", 200.0, 1.0).startswith("KITTI 6, worst 40; Shrimp 2, worst 9; his files")
    assert beside("timing", "dt", 200.0, 0.1) == ""
    assert "1.69" in beside("panoramic", "rotation", 30.0, 0.0)


# ---- statistics


def of_all(rows, parameter, estimator="paper", seconds="20"):
    """Statistics of one estimator at one length."""
    some = [r for r in rows if (r["estimator"], r["seconds"]) == (estimator, seconds)]
    return summary.statistics(some, parameter, summary.told_by_all(rows, parameter))


def test_statistics_are_those_of_the_absolute_errors():
    s = of_all(rows_of([0.5, -1.5, 2.5, -4.0, None, np.nan]), "dt")
    assert s.error.tolist() == [0.5, 1.5, 2.5, 4.0]
    assert (s.sections, s.refused, s.undetermined, s.no_truth) == (6, 1, 1, 0)
    assert [s.within(k) for k in (1, 2, 3)] == [0.25, 0.5, 0.75]
    head, line = summary.table("timing", rows_of([0.5, -1.5, 2.5, -4.0, None, np.nan]), "dt")
    told = dict(zip(head, line, strict=True))
    assert (told["median"], told["worst"], told["mean"]) == ("2.00", "4.00", "2.12")
    assert told["p95"] == f"{np.percentile([0.5, 1.5, 2.5, 4.0], 95):.2f}"
    assert told["RMS"] == f"{np.sqrt((0.25 + 2.25 + 6.25 + 16) / 4):.2f}"
    assert told["within 1/2/3 sigma %"] == "25/50/75"
    assert (told["sections"], told["refused"], told["left open"]) == ("6", "1", "1")


def test_a_length_that_was_always_refused_keeps_its_line():
    head, line = summary.table("timing", rows_of([None, None]), "dt")
    told = dict(zip(head, line, strict=True))
    assert (told["median"], told["sections"], told["refused"]) == ("", "2", "2")


def test_euler_errors_are_held_against_sigma_as_delta():
    (row,) = rows_of([1.0])
    row |= {"roll_deg": "1", "sigma_roll_deg": "9", "rx_deg": "1.5", "sigma_rx_deg": "0.5"}
    s = of_all([row], "roll")
    assert (s.error.tolist(), s.sigma.tolist(), s.checked.tolist(), s.stated.tolist()) == ([1.0], [9.0], [1.5], [0.5])
    assert [s.within(k) for k in (2, 3)] == [0, 1]


def test_a_stated_sigma_of_zero_is_held_against_the_error():
    rows = [{**r, "sigma_dt_ms": "0"} for r in rows_of([0.0, 4.0])]
    told = dict(zip(*summary.table("timing", rows, "dt"), strict=True))
    assert (told["worst"], told["sigma"], told["within 1/2/3 sigma %"]) == ("4.00", "0.00", "50/50/50")


def test_estimators_are_compared_over_what_all_of_them_tell():
    ours, theirs = [1.0, np.nan, None, 2.0], [3.0, 100.0, 100.0, None]
    rows = rows_of(ours) + rows_of(theirs, estimator="other") + rows_of([None] * 4, estimator="never")
    head, *lines = summary.table("timing", rows, "dt")
    told = {cells["estimator"]: cells for line in lines if (cells := dict(zip(head, line, strict=True)))}
    assert (told["paper"]["mean"], told["paper"]["not by all"]) == ("1.00", "1")
    assert (told["other"]["mean"], told["other"]["not by all"]) == ("3.00", "2")
    # one that tells nothing at all keeps nobody from being told
    assert (told["never"]["mean"], told["never"]["refused"]) == ("", "4")
    alone = rows_of([np.nan] * 2, seconds="10") + rows_of([5.0] * 2, seconds="10", estimator="other")
    assert of_all(rows + alone, "dt", "other", "10").error.tolist() == [5.0, 5.0]


def test_lines_come_by_spread_then_length():
    rows = rows_of([1.0], seconds="100") + rows_of([1.0], seconds="20") + rows_of([1.0], spread="0.1")
    assert [(a, b) for a, b, _, _ in summary.groups(rows)] == [(0.1, 20.0), (1.0, 20.0), (1.0, 100.0)]
