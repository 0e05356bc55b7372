"""The experiments on what the sensors see: starts, searches with and without the motion, tables and figures."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, drive
from click.testing import CliRunner
from numpy.testing import assert_allclose

from calib_toolkit import Config, CostMetric, Log, cli, se3
from calib_toolkit.appearance import search
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.evaluation import drives, experiment, figures, sections, shares, sights, summary
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.plugins import Registry
from calib_toolkit.progress import Silent
from calib_toolkit.timing import TimingOptions
from calib_toolkit.types import Trajectory
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth

FAST = Config(method="paper", jobs=1, timing=TimingOptions(steps=300), appearance=("bowl",), moments=12)
SIGMA = (0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4)
SHAPE = np.array([10.0] * 3 + [100.0] * 3)
NOISE = np.array([0.005] * 3 + [0.0005] * 3)


class Bowl(CostMetric):
    """Costs like a bowl around the true pose, which is a little different at every moment."""

    id = "bowl"

    def __init__(self, best, noise=NOISE, shift=0.0):
        self.best, self.noise, self.shift = best, noise, shift

    def accepts(self, kind_a, kind_b):
        return True

    def prepare(self, pair, options):
        return np.random.default_rng(int(pair.selected[0, 1])).normal(size=6) * self.noise + self.shift

    def cost(self, T_a_b, pair):
        return float(self.costs(T_a_b[None], pair)[0])

    def costs(self, T_a_b, moment):
        turn = se3.log_so3(T_a_b[:, :3, :3] @ self.best[:3, :3].T)
        error = np.column_stack([T_a_b[:, :3, 3] - self.best[:3, 3], turn])
        return np.sum(((error - moment) * SHAPE) ** 2, axis=1)


class Installed(Registry):
    """A registry that holds these metrics and nothing else."""

    def __init__(self, **metrics):
        super().__init__(())
        self.there = metrics

    @property
    def metrics(self):
        return self.there


def a_drive(seconds=25.0, cameras=1, name="rough"):
    """A lidar and cameras as the experiments see them."""
    sensors = [SimulatedSensor("velo", LIDAR, sigma=SIGMA)]
    mounts = (CAMERA, INS)[:cameras]
    sensors += [SimulatedSensor(f"cam{k}", T, dt=0.02, has_scale=False, sigma=SIGMA) for k, T in enumerate(mounts)]
    true = path(seconds, 3, "rough")
    log = Log(Path(name), {s.name: measure(true, s, 3) for s in sensors})
    return drives.Drive(name, log, drive(true, sensors, 3), tuple(s.name for s in sensors), truth(sensors))


@pytest.fixture(scope="module")
def two():
    return a_drive()


@pytest.fixture
def bowl(two, monkeypatch):
    """The one metric that is installed."""
    metric = Bowl(two.truth.between("velo", "cam0").T_a_b)
    monkeypatch.setattr(sights, "registry", lambda: Installed(bowl=metric))
    return metric


def section_of(one, name="appearance", repeat=0, wider=1.0, seconds=20.0):
    draw = sections.Draw(0, seconds, 0.0, repeat)
    return sections.with_sight(sections.cut(draw, [one], name, 0), draw, one, wider)


def run(name, one, folder, repeats=2, **choices):
    chosen = experiment.Choices(repeats, (100.0,), ("paper",), **choices)
    return experiment.run(name, [one], folder, chosen, FAST, Silent())


# ---- sections


def test_a_section_holds_what_was_seen_in_it_and_no_more(two):
    section = section_of(two)
    first = two.span[0] + section.start
    for name, stream in section.log.streams.items():
        there = two.log.streams[name].stamps
        assert_allclose(stream.stamps, there[(there >= first) & (there <= first + 20.0)])
        assert_allclose(section.paths[name].start, section.motions[name].start)


def test_poses_are_cut_as_motions_are(two):
    n = 300
    drift = np.tile(np.eye(6), (n, 1, 1))
    told = Trajectory(0.1 * np.arange(n), np.tile(np.eye(4), (n, 1, 1)), drift.copy(), drift)
    one = replace(two, paths={**two.motions, "velo": told})
    part = section_of(one, seconds=10.0).paths["velo"]
    assert 90 < len(part) <= 101
    assert not part.drift[0].any()
    assert part.drift[1:].any()
    assert told.drift.all(axis=0).any(), "the recording itself is left alone"


def test_drives_that_are_too_short_are_taken_whole_and_that_is_said(two, tmp_path, bowl):
    done = run("full", two, tmp_path, repeats=1)
    assert {r["seconds"] for r in done.rows} == {"24"}
    assert done.skipped == ["100 s: longer than every drive; sections of 24 s instead"]
    assert sections.fitting([two], (20.0,)) == ((20.0,), [])


# ---- appearance


def test_starts_are_off_as_the_motion_says(two):
    section = section_of(two)
    motion = sights.calibrate_motions(section.motions, FAST, section.clocks).calibration
    wide = []
    for wider in (1.0, 3.0):
        errors = []
        for seed in range(200):
            start = sights.drawn(motion, replace(section, seed=seed, wider=wider))
            T, true = start.T_base_sensor[1], two.truth.T_base_sensor[1]
            errors.append(np.concatenate([T[:3, 3] - true[:3, 3], se3.log_so3(T[:3, :3] @ true[:3, :3].T)]))
        sigma = np.sqrt(np.diag(start.covariance))[7:13]
        assert_allclose(np.std(errors, axis=0), sigma, rtol=0.25)
        wide.append(sigma)
    assert_allclose(wide[1], 3 * wide[0])
    assert_allclose(start.T_base_sensor[0], two.truth.T_base_sensor[0])


def test_every_metric_is_told_alone_with_the_motion_and_without_its_sigma(two, bowl):
    found = {f.estimator: f for f in sights.measure_appearance(section_of(two), [FAST], [])}
    assert list(found) == PROTOCOLS["appearance"].estimators(["paper"], False, ["bowl"])
    for way in sights.WAYS:
        f = found[f"bowl{way}"]
        assert not f.refused
        assert f.error["translation"] < 0.02
        assert f.error["rotation"] < 0.2
        assert "dt" not in f.error
    assert found["bowl-alone"].sigma["x"] > 0
    assert found["bowl-constrained"].sigma["x"] <= found["bowl-alone"].sigma["x"]
    assert not found["bowl-unconstrained"].sigma


def test_a_search_without_the_motions_sigma_goes_further_than_one_with_it(two, bowl):
    """A metric whose best pose is half a metre off is refused with the motion's sigma, and believed without it."""
    bowl.shift = np.array([0.5, 0.5, -0.5, 0.0, 0.0, 0.3])
    found = {f.estimator: f for f in sights.measure_appearance(section_of(two), [FAST], [])}
    assert "further from the motion's than its sigma allows" in found["bowl-constrained"].refused
    assert found["bowl-unconstrained"].error["x"] == pytest.approx(0.5, abs=0.05)
    assert np.radians(found["bowl-unconstrained"].error["rotation"]) == pytest.approx(0.3, abs=0.02)


def test_an_unconstrained_search_stays_within_a_metre(two, bowl):
    bowl.shift = np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    section = section_of(two)
    start = sights.drawn(sights.calibrate_motions(section.motions, FAST, section.clocks).calibration, section)
    (c,) = sights.comparisons(section.log, section.paths, start, {"bowl": bowl}, 25, 0)
    T = search.unconstrained(bowl, c.pair, None, 0)
    assert T[0, 3] - c.pair.prior.T_a_b[0, 3] == pytest.approx(1.0, abs=0.02)


def test_what_sees_nothing_together_is_refused_by_name(two, bowl):
    bowl.overlap = lambda pair: False
    initial, *others = sights.measure_appearance(section_of(two), [FAST], [])
    assert not initial.refused
    assert [f.refused for f in others] == ["bowl: the two do not see the same where the start puts them"] * 3


def test_one_metric_that_fails_takes_no_other_with_it(two, bowl, monkeypatch):
    class Broken(Bowl):
        id = "broken"

        def costs(self, T_a_b, moment):
            raise ZeroDivisionError("it fell")

    metrics = {"broken": Broken(bowl.best), "bowl": bowl}
    monkeypatch.setattr(sights, "registry", lambda: Installed(**metrics))
    config = replace(FAST, appearance=("broken", "bowl"))
    found = sights.measure_appearance(section_of(two), [config], [])
    assert [f.refused for f in found if f.estimator.startswith("broken")] == [
        "unexpected ZeroDivisionError: it fell"
    ] * 3
    assert not any(f.refused for f in found if f.estimator.startswith("bowl"))


def test_metrics_are_those_that_search_and_take_the_two(two, bowl):
    class Never(Bowl):
        def accepts(self, kind_a, kind_b):
            return False

    installed = Installed(bowl=bowl, never=Never(None), other=object())
    assert sights.metrics_of(two.log, Config(), installed) == ("bowl",)
    assert sights.metrics_of(two.log, FAST, installed) == ("bowl",)
    with pytest.raises(ConfigError, match="and never does not; choose others with --appearance"):
        sights.metrics_of(two.log, replace(FAST, appearance=("bowl", "never")), installed)
    with pytest.raises(ConfigError, match="there is no metric 'sonar'"):
        sights.metrics_of(two.log, replace(FAST, appearance=("sonar",)), installed)


def test_a_recording_without_a_lidar_and_a_camera_is_refused(two):
    with pytest.raises(DataError, match=r"no lidar and camera .*\(it has: velo, \w+; cam0, \w+\); name two with"):
        drives.lidar_and_camera(two.log)
    with pytest.raises(DataError, match=r"no two sensors that an installed .*\(it has: velo, \w+; cam0, \w+\); use"):
        drives.everyone(two.log)


def test_a_truth_without_positions_is_refused(two):
    known = two.truth.determined.copy()
    known[1, 0] = False
    blind = replace(two.truth, determined=known)
    with pytest.raises(DataError, match="does not say where the sensor is and how it is turned of cam0 against velo"):
        experiment.check(PROTOCOLS["appearance"], {"rough": blind})
    experiment.check(PROTOCOLS["full"], {"rough": blind})


# ---- full


def test_every_sensor_is_told_before_and_after(tmp_path, bowl):
    three = a_drive(cameras=2)
    found = sights.measure_full(section_of(three, "full"), [FAST], [])
    assert [(f.estimator, f.sensor) for f in found] == [
        (f"paper{way}", n) for way in ("-motion", "-combined") for n in ("cam0", "cam1")
    ]
    before, after = ({f.sensor: f for f in found if f.estimator.endswith(w)} for w in ("-motion", "-combined"))
    assert after["cam0"].sigma["z"] < before["cam0"].sigma["z"]
    assert after["cam0"].error["translation"] < 0.03


def test_nothing_that_overlaps_leaves_the_motion_and_refuses_the_rest(two, bowl):
    bowl.overlap = lambda pair: False
    before, after = sights.measure_full(section_of(two, "full"), [FAST], [])
    assert before.error
    assert not before.refused
    assert "no two sensors see the same" in after.refused


# ---- tables and figures


@pytest.fixture(scope="module")
def done(two, tmp_path_factory):
    """Both experiments with two repeats: folder and outcome by name."""
    with pytest.MonkeyPatch.context() as patch:
        metric = Bowl(two.truth.between("velo", "cam0").T_a_b)
        patch.setattr(sights, "registry", lambda: Installed(bowl=metric))
        folder = tmp_path_factory.mktemp("out")
        return folder, {name: run(name, two, folder, 2) for name in ("appearance", "full")}


@pytest.mark.parametrize("name", ["appearance", "full"])
def test_a_cut_table_is_completed_to_the_same_bytes(name, two, done, bowl):
    folder, _ = done
    whole = (folder / f"{name}.csv").read_bytes()
    lines = whole.splitlines(keepends=True)
    (folder / f"{name}.csv").write_bytes(b"".join(lines[: len(lines) // 2]))
    run(name, two, folder, 2)
    assert (folder / f"{name}.csv").read_bytes() == whole
    with pytest.raises(DataError, match=r"begun with wider = 1\.0, and this is 2\.0"):
        run(name, two, folder, 2, wider=2.0)


def test_repeats_differ_in_start_and_search(done):
    rows = [r for r in done[1]["appearance"].rows if r["estimator"] == "initial"]
    assert len({r["x_m"] for r in rows}) == 2


@pytest.mark.parametrize("name", ["appearance", "full"])
def test_summary_and_figure_are_made(name, done, tmp_path):
    text = summary.markdown(name, done[1][name])
    assert ("(Table I)" if name == "appearance" else "(Table II)") in text
    figures.draw(name, done[1][name].rows, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def row(estimator, sensor="velo-cam0", status="found", **values):
    numbers = {f"{s}{p}": "0.1" for s in ("", "sigma_") for p in columns()}
    made = dict.fromkeys(numbers, "") if status == "refused" else numbers
    return {**made, "estimator": estimator, "sensor": sensor, "status": status, **values}


def columns():
    return [*(f"{p}_m" for p in "xyz"), *(f"{p}_deg" for p in ("roll", "pitch", "yaw", "rx", "ry", "rz"))]


def test_within_counts_every_axis_and_no_refusal():
    rows = [row("initial", x_m="0.31"), row("initial", rz_deg="-2.1"), row("initial", y_m="-0.3", rx_deg="2")]
    rows += [row("im-constrained"), row("im-constrained", status="refused"), row("im-unconstrained", z_m="-0.5")]
    head, *lines = shares.within(rows)
    told = [dict(zip(head, line, strict=True)) for line in lines]
    assert [(t["metric"], t["search"], t["right / all"], t["refused"], t["in the paper %"]) for t in told] == [
        ("initial", "", "1 / 3", "0", "43"),
        ("im", "constrained", "1 / 2", "1", "100"),
        ("im", "unconstrained", "0 / 1", "0", "23"),
    ]
    # Wilson's interval of 1 of 2, from its formula
    z2 = 1.959964**2
    middle, half = 0.5, np.sqrt(z2 * (0.25 / 2 + z2 / 16)) / (1 + z2 / 2)
    assert told[1]["95 % interval"] == f"{100 * (middle - half):.0f} to {100 * (middle + half):.0f}"


def test_each_sensors_means_sigmas_and_coverage():
    rows = [
        row("joint-combined", "cam0", x_m="-0.1", sigma_x_m="0.06"),
        row("joint-combined", "cam0", x_m="0.3", sigma_x_m="0.06"),
        row("joint-combined", "cam0", status="refused"),
    ]
    head, line, paper = shares.by_sensor(rows)
    told = dict(zip(head, line, strict=True))
    assert (told["x m"], told["sigma x"], told["left open or refused"]) == ("0.200", "0.060", "1 of 3")
    assert told["within 1/2/3 sigma %"] == "83/92/92"
    assert dict(zip(head, paper, strict=True))["roll deg"] == "0.438"


@pytest.mark.parametrize("name", ["appearance", "full"])
def test_no_text_of_a_full_figure_lies_on_another(name):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rng = np.random.default_rng(0)
    known = PROTOCOLS[name].estimators(["joint", "paper"], False, ["nmi", "gom", "levinson", "im"])
    sensors = ["velo-cam0"] if name == "appearance" else ["cam0", "cam1", "cam2", "cam3", "ins"]
    rows = [
        row(e, s, **{f"{sign}{c}": f"{abs(rng.normal()) * 0.2:.3f}" for sign in ("", "sigma_") for c in columns()})
        for e in known
        for s in sensors
        for _ in range(20)
    ]
    figure = Figure(layout="constrained", dpi=110)
    figures.fill(name, figure, rows)
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    texts = list(legend.get_texts())
    for panel in figure.axes:
        texts += [panel.title, panel.xaxis.label, panel.yaxis.label]
        texts += [tick.label1 for tick in panel.xaxis.get_major_ticks()]
    boxes = [t.get_window_extent() for t in texts if t.get_text()]
    width = figure.canvas.get_width_height()[0]
    for k, box in enumerate(boxes):
        assert 0 <= box.x0 <= box.x1 <= width
        assert not any(box.overlaps(b) for b in boxes[k + 1 :])


# ---- the command


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("appearance", "--baseline"), "hand-eye calibration sees nothing"),
        (("full", "--appearance", "sonar"), "there is no metric 'sonar'"),
        (("full", "--appearance", "none"), "compares with what the sensors see, which takes a metric"),
        (("appearance", "--appearance", "map"), "does not; choose others with --appearance"),
    ],
)
def test_what_can_not_be_done_is_one_sentence(arguments, sentence, tmp_path):
    (tmp_path / "simulated.toml").write_text(
        "seconds = 30\nseed = 3\n[sensors.velo]\npose = [0, 0, 1.7, 0, 0, 0]\n"
        "[sensors.ins]\npose = [-0.8, 0.3, 0.9, 0, 0, 1]\n"
    )
    named = ("--sensors", "velo,ins", "--repeats", "1", "--jobs", "1", "-o", str(tmp_path / "out"))
    done = CliRunner().invoke(cli.main, ["evaluate", arguments[0], str(tmp_path), *arguments[1:], *named])
    assert done.exit_code == 1, done.output
    assert sentence in done.output


@pytest.mark.long
def test_a_rendered_drive_is_searched_and_summed_up(tmp_path):
    source, out = tmp_path / "drive", tmp_path / "out"
    made = ["simulate", str(source), "--rig", "kitti", "--sensors", "velo,cam0", "--seconds", "15", "--jobs", "1"]
    assert CliRunner().invoke(cli.main, made).exit_code == 0
    known = ["--appearance", "im", "--method", "joint", "--repeats", "1", "--jobs", "1", "-o", str(out)]
    for name in ("appearance", "full"):
        done = CliRunner().invoke(cli.main, ["evaluate", name, str(source), *known])
        assert done.exit_code == 0, done.output
        with (out / f"{name}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == (4 if name == "appearance" else 2)
        last = rows[2] if name == "appearance" else rows[1]
        assert last["status"] == "found", last["note"]
        assert float(last["translation_m"]) < 0.3
        assert float(last["rotation_deg"]) < 2
