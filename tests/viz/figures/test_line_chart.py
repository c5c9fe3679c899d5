"""Line charts: lines lie where their numbers are, gaps stay empty, axes have round numbers."""

import torch

from torchface.viz.figures.line_chart import LineChart, round_numbers


def test_a_line_lies_where_its_numbers_are_and_has_gaps() -> None:
    chart = LineChart(220, 120)
    panel = chart.panel((10, 10, 210, 110), (0.0, 4.0), (0.0, 1.0))
    panel.line(torch.arange(5.0), torch.tensor([0.25, 0.25, torch.nan, 0.75, 0.75]), "#ff0000")
    red = chart.picture()[0] - chart.picture()[2] > 0.5
    rows, columns = red.nonzero().T
    assert set(rows[columns < 100].tolist()) <= {84, 85, 86}
    assert set(rows[columns > 120].tolist()) <= {34, 35, 36}
    assert not bool(red[:, 65:155].any())
    assert bool(red[84:87, 20:55].any(0).all())


def test_numbers_of_axes_are_round() -> None:
    assert round_numbers(-9.4, 9.4, 5) == [(-5.0, "-5"), (0.0, "0"), (5.0, "5")]
    assert [text for _, text in round_numbers(0.0, 0.31, 4)] == ["0.0", "0.1", "0.2", "0.3"]
    assert round_numbers(2.0, 2.0, 4) == [(2.0, "2")]
