"""Which parts of which drives are taken, what their clocks say, and which truth they have."""

import numpy as np
import pytest
from builders import INS, LIDAR, MOUNTS, in_base
from recorded_drives import a_drive, sensor

from calib_toolkit import Log
from calib_toolkit.errors import DataError
from calib_toolkit.evaluation import drives
from calib_toolkit.evaluation.sections import Draw, cut, plan
from calib_toolkit.types import Motions
from calib_toolkit_datasets.simulated import truth
from calib_toolkit_datasets.simulation.ins import InsModel
from calib_toolkit_datasets.simulation.rigs import Mounted, Rig
from calib_toolkit_datasets.simulation.rigs import truth as rig_truth

# ---- sections


def test_drives_take_turns_and_short_ones_are_said_to_be(two, ring):
    short = a_drive([sensor("velo", LIDAR), sensor("ins", INS)], seconds=15.0, name="short")
    draws, skipped = plan([two, short], (10.0, 30.0, 90.0), (0.1, 1.0), 3)
    assert [d.drive for d in draws if d.seconds == 10.0] == [0, 1, 0] * 2
    assert [d.drive for d in draws if d.seconds == 30.0] == [0] * 6
    assert [d.seconds for d in draws].count(90.0) == 0
    assert [d.spread for d in draws][:6] == [0.1] * 3 + [1.0] * 3
    assert len(skipped) == 2
    assert skipped[0].startswith("30 s: longer than short (")
    assert skipped[1].startswith("90 s: longer than rough, short (")


def test_a_section_lies_in_the_drive_and_is_told_by_the_seed_alone(two):
    draws, _ = plan([two], (20.0,), (0.0,), 40)
    cuts = [cut(d, [two], "pair", 5) for d in draws]
    starts = np.array([c.start for c in cuts])
    first, last = two.span
    assert starts.min() >= 0
    assert starts.max() <= last - first - 20
    assert np.ptp(starts) > 0.8 * (last - first - 20)  # over the whole drive
    for c in cuts:
        for m in c.motions.values():
            assert m.start[0] >= first + c.start
            assert first + c.start + 20 >= m.end[-1] > first + c.start + 19.7
    again = cut(Draw(0, 20.0, 0.0, 7), [two], "pair", 5)
    assert again.start == cuts[7].start
    others = [cut(Draw(0, 20.0, 0.0, 7), [two], "pair", 6), cut(Draw(0, 20.0, 0.0, 7), [two], "timing", 5)]
    others.append(cut(Draw(0, 20.0, 0.0, 8), [two], "pair", 5))
    assert again.start not in [o.start for o in others]


def test_clocks_are_moved_and_the_truth_with_them(two):
    still, near, far = (cut(Draw(0, 20.0, spread, 3), [two], "timing", 0) for spread in (0.0, 0.1, 1.0))
    assert near.start == far.start
    shift = [c.motions["ins"].start[0] - still.motions["ins"].start[0] for c in (near, far)]
    applied = [two.truth.dt_base_sensor[1] - c.truth.dt_base_sensor[1] for c in (near, far)]
    assert applied[1] == pytest.approx(10 * applied[0])
    assert 0 < abs(applied[0]) <= 0.1
    assert shift == pytest.approx(applied)
    # the base stays where it is
    assert near.truth.dt_base_sensor[0] == 0
    kept = two.motions["velo"].start
    assert np.isin(near.motions["velo"].start, kept).all()


def test_a_section_of_skewed_clocks_is_as_late_as_its_readings_were():
    """Against readings stamped by the simulated clocks themselves: no formula of the drift here."""
    still = InsModel()
    late = Mounted("late", "gps_ins", INS, still, rate=20.0, dt=0.02, skew=1e-3)
    base = Mounted("base", "gps_ins", LIDAR, still, rate=10.0, dt=-0.01, skew=-5e-4)
    motions = {}
    for s in (base, late):
        stamps = s.stamps(100.0, 1) / 1e9
        n = len(stamps) - 1
        motions[s.name] = Motions(stamps[:-1], stamps[1:], np.zeros((n, 6)), np.broadcast_to(np.eye(6), (n, 6, 6)))
    known = drives.rebased(rig_truth(Rig((base, late), "street", "street"), 0.0), ("base", "late"), "a drive")
    skewed = drives.Drive("d", Log(None, {}), motions, ("base", "late"), known)
    for repeat in range(3):
        c = cut(Draw(0, 20.0, 0.0, repeat), [skewed], "pair", 0)
        stamps = c.motions["late"].start
        # what the base's clock says at the instant of each reading
        instants = late.instants(np.round(stamps * 1e9))
        on_base = (instants - base.dt) / (1 + base.skew)
        middle = skewed.span[0] + c.start + 10.0
        k = int(np.argmin(np.abs(stamps - middle)))
        assert stamps[k] + c.truth.dt_base_sensor[1] == pytest.approx(on_base[k], abs=1e-4)
        assert abs(stamps[0] + c.truth.dt_base_sensor[1] - on_base[0]) > 5e-3  # it drifts


# ---- drives and their truth


def test_the_truth_is_seen_from_the_base(two):
    sensors = [sensor(f"s{k}", T, dt=0.1 * k) for k, T in enumerate(MOUNTS)]
    seen = drives.rebased(truth(sensors), ("s2", "s4", "s0"), "a drive")
    assert (seen.base, seen.names) == ("s2", ("s2", "s4", "s0"))
    np.testing.assert_allclose(seen.T_base_sensor, in_base([MOUNTS[2], MOUNTS[4], MOUNTS[0]]), atol=1e-12)
    np.testing.assert_allclose(seen.dt_base_sensor, [0, 0.2, -0.2], atol=1e-12)
    assert seen.determined.all()


@pytest.mark.parametrize(
    ("unknown", "lost"),
    [
        (("s0", slice(0, 3)), {"s0": "t", "s1": "t", "s2": "t"}),  # where the base sits
        (("s1", slice(0, 3)), {"s1": "t"}),
        (("s1", slice(3, 6)), {"s1": "R"}),
        (("s0", slice(3, 6)), {"s0": "tR", "s1": "tR", "s2": "tR"}),
        (("s0", slice(6, 7)), {"s0": "d", "s1": "d", "s2": "d"}),
        (("s2", slice(6, 7)), {"s2": "d"}),
    ],
)
def test_what_the_truth_leaves_open_stays_open(unknown, lost):
    sensors = [sensor(f"s{k}", T) for k, T in enumerate(MOUNTS[:3])]
    there = truth(sensors)
    there.determined[there.index(unknown[0]), unknown[1]] = False
    seen = drives.rebased(there, ("s0", "s1", "s2"), "a drive").determined
    for k, name in enumerate(("s0", "s1", "s2")):
        told = lost.get(name, "")
        assert seen[k].tolist() == ["t" not in told] * 3 + ["R" not in told] * 3 + ["d" not in told]


def test_sensors_that_the_truth_does_not_hold_are_refused():
    there = truth([sensor("velo", LIDAR), sensor("ins", INS)])
    with pytest.raises(DataError, match=r"truth of a drive holds nothing on sensor 'cam9', only on velo, ins; leave"):
        drives.rebased(there, ("velo", "cam9"), "a drive")


def test_the_paper_decides_which_sensors_are_compared(two, ring):
    both = Log(None, {**ring.log.streams, **two.log.streams})
    assert drives.cameras(both) == ["cam0", "cam1", "cam2"]
    assert drives.first_two(both) == ["velo", "ins"]
    with pytest.raises(DataError, match="has no camera, where this experiment compares at least two"):
        drives.cameras(two.log)
    with pytest.raises(DataError, match="no two sensors that measure distances"):
        drives.first_two(ring.log)
