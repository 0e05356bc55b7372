"""Tables, figures and the command of the experiments on what the sensors see."""

import csv

import numpy as np
import pytest
from bowls import Bowl, Installed, run
from click.testing import CliRunner

from calib_toolkit import cli
from calib_toolkit.errors import DataError
from calib_toolkit.evaluation import figures, shares, sights, summary
from calib_toolkit.evaluation.protocols import PROTOCOLS

# ---- tables and figures


@pytest.fixture(scope="module")
def done(seen, tmp_path_factory):
    """Both experiments with two repeats: folder and outcome by name."""
    with pytest.MonkeyPatch.context() as patch:
        metric = Bowl(seen.truth.between("velo", "cam0").T_a_b)
        patch.setattr(sights, "registry", lambda: Installed(bowl=metric))
        folder = tmp_path_factory.mktemp("out")
        return folder, {name: run(name, seen, folder, 2) for name in ("appearance", "full")}


@pytest.mark.parametrize("name", [pytest.param("appearance", marks=pytest.mark.long), "full"])
def test_a_cut_table_is_completed_to_the_same_bytes(name, seen, done, bowl):
    folder, _ = done
    whole = (folder / f"{name}.csv").read_bytes()
    lines = whole.splitlines(keepends=True)
    (folder / f"{name}.csv").write_bytes(b"".join(lines[: len(lines) // 2]))
    run(name, seen, folder, 2)
    assert (folder / f"{name}.csv").read_bytes() == whole
    with pytest.raises(DataError, match=r"begun with wider = 1\.0, and this is 2\.0"):
        run(name, seen, folder, 2, wider=2.0)


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
