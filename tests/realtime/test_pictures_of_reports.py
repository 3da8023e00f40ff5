"""Pictures of reports draw no line across a gap, and name what they show in words."""

import numpy as np
from matplotlib.figure import Figure

from rollerrig.realtime.pictures import gaps
from rollerrig.realtime.reports import cause_pictures, page
from rollerrig.realtime.reports.creep_curve import tuned
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Curve
from rollerrig.rig.identify.paper import polach_fit


def test_a_line_breaks_at_each_gap_and_nowhere_else():
    time_s = np.array([0.0, 0.1, 0.2, 2.0, 2.1, 5.0])
    speed_m_s = np.arange(6.0)
    broken_s, broken_m_s = gaps.with_breaks(time_s, 0.5, speed_m_s)
    assert np.isnan(broken_m_s).sum() == 2
    assert np.array_equal(broken_m_s[np.isfinite(broken_m_s)], speed_m_s)
    # the breaks are inside the gaps
    assert np.allclose(broken_s[np.isnan(broken_m_s)], [1.1, 3.55])
    whole_s, whole_m_s = gaps.with_breaks(time_s[:3], 0.5, speed_m_s[:3])
    assert np.array_equal(whole_s, time_s[:3])
    assert np.array_equal(whole_m_s, speed_m_s[:3])


def test_means_of_bins_are_not_connected_across_a_gap_of_their_covariate():
    x = np.concatenate([np.linspace(0.0, 10.0, 600), np.linspace(40.0, 50.0, 600)])
    edges = np.quantile(x, np.linspace(0.0, 1.0, 13))
    means = cause_pictures.binned(x, x, np.arange(x.size), edges)
    assert np.isnan(means.x).sum() == 1
    before, after = np.split(means.x, np.flatnonzero(np.isnan(means.x)))
    assert before.max() < 10.0
    assert after[1:].min() > 40.0
    unbroken = cause_pictures.binned(x[:600], x[:600], np.arange(600), edges[:7])
    assert not np.isnan(unbroken.x).any()


def test_the_maximum_that_a_creep_curve_marks_is_that_of_the_drawn_law():
    grid = np.linspace(0.0, 0.2, 400)
    full = np.ones(grid.size)
    curve = Curve(grid, grid, 10.0 * full, 1e5 * full, full)
    parameters = np.array(polach_fit.RECOMMENDED["dry"])
    patch = patch_of(dataset.load("eurosprinter_127001"))
    law = polach_fit.model(parameters, curve, patch)
    axes = Figure().subplots()
    axes.plot(100.0 * grid, law)
    tuned.draw_maximum(axes, grid, law, "black")
    drawn, marked = axes.lines
    assert 0 < np.argmax(law) < law.size - 1
    assert marked.get_ydata()[0] == drawn.get_ydata().max()
    assert marked.get_xdata()[0] == drawn.get_xdata()[np.argmax(law)]
    # a law that only rises has no maximum to mark
    rising = Figure().subplots()
    tuned.draw_maximum(rising, grid, grid, "black")
    assert not rising.lines


def test_an_axis_of_many_powers_of_ten_has_labels_that_a_reader_knows():
    def draw(figure):
        axes = figure.subplots()
        axes.plot([1.0, 2.0], [1.0, 1e-8])
        axes.set_yscale("log")
        page.plain_logarithm(axes.yaxis)

    picture = page.picture(draw)
    assert "10⁻⁶" in picture
    assert "mathdefault" not in picture
