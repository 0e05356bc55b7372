"""The figures of the experiments."""

import numpy as np
import pytest
from recorded_drives import FAST, rows_of

from calib_toolkit.config import METHODS
from calib_toolkit.evaluation import baselines, experiment, figures
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.progress import Silent


@pytest.mark.parametrize("name", [n for n, p in PROTOCOLS.items() if not p.sees])
def test_figures_are_drawn(name, two, ring, tmp_path):
    from matplotlib.image import imread

    over = two if name == "pair" else ring
    done = experiment.run(name, [over], tmp_path, experiment.Choices(1, (15.0,)), FAST, Silent())
    figures.draw(name, done.rows, tmp_path / "figure.png")
    image = imread(tmp_path / "figure.png")
    assert image.shape[0] > 300
    assert 0.5 < image[..., :3].mean() < 0.99


TWO = (*METHODS, "another")[:2]


def full_table(name):
    """Rows of two methods, all baselines and every length of the paper, drawn at random."""
    there, rng = PROTOCOLS[name], np.random.default_rng(3)
    methods = [f"{m}{way}" for m in TWO for way in there.ways]
    plain = [] if name == "timing" else ["least-squares", *(baselines.OPENCV_METHODS if name == "pair" else ())]
    rows = []
    for seconds in there.seconds:
        for estimator in (*methods, *plain):
            row = dict.fromkeys(experiment.columns(there), "")
            row |= {
                "drive": "d",
                "estimator": estimator,
                "sensor": "a-b",
                "status": "found",
                "seconds": f"{seconds:g}",
            }
            numbers = [c for c in row if c.endswith(("_deg", "_m", "_ms"))]
            rows += [
                row | {"spread": f"{spread:g}", "repeat": str(k)} | {c: f"{abs(rng.normal()):.3f}" for c in numbers}
                for spread in there.spreads
                for k in range(100 if name == "panoramic" else 3)
            ]
    return rows


@pytest.mark.parametrize("name", [n for n, p in PROTOCOLS.items() if not p.sees])
def test_in_a_full_figure_every_estimator_has_its_colour_and_no_text_lies_on_another(name, monkeypatch):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    monkeypatch.setitem(figures.STYLES, "another", ("o", figures.OURS[1]))
    figure, rows = Figure(layout="constrained", dpi=110), full_table(name)
    figures.fill(name, figure, rows)
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    told = [t.get_text() for t in legend.get_texts()]
    expected = {r["estimator"].removesuffix("-together").removesuffix("-separate") for r in rows}
    assert expected <= set(told)
    assert len({figures.STYLES[m][1] for m in expected}) == len(expected)
    texts = list(legend.get_texts())
    for panel in figure.axes:
        lo, hi = panel.get_xlim()
        texts += [panel.title, panel.xaxis.label, panel.yaxis.label]
        texts += [tick.label1 for tick in panel.xaxis.get_major_ticks() if lo <= tick.get_loc() <= hi]
    texts = [t for t in texts if t.get_visible() and t.get_text()]
    boxes = [t.get_window_extent() for t in texts]
    width = figure.canvas.get_width_height()[0]
    for k, (text, box) in enumerate(zip(texts, boxes, strict=True)):
        assert box.x0 >= 0, text
        assert box.x1 <= width, text
        assert not any(box.overlaps(b) for b in boxes[k + 1 :]), text


def test_figures_stand_a_table_without_any_number(tmp_path):
    figures.draw("timing", rows_of([None, np.nan]), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000
