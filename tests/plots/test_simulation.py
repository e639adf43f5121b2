"""Pictures of simulations mean the same side by side: scale, unit, direction and colours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from error_maps import errors_of
from gpuvision.plots.simulation import PictureScale, draw_causes, draw_errors


def test_errors_that_are_compared_have_one_scale_and_unit(drawn: list[Figure], tmp_path: Path) -> None:
    """One sensor errs by up to a millimetre, the other one by half of that: the same colour is the same error."""
    large, small = errors_of(np.full((5, 7), 0.6e-3)), errors_of(np.full((4, 9), -0.3e-3))
    scale = PictureScale.of([large, small], 20e-6)
    assert scale == (pytest.approx(1e-3), 20e-6)
    for number, errors in enumerate((large, small)):
        draw_errors(tmp_path / f"{number}.png", errors, "part", scale)
    for figure, value in zip(drawn, (0.6, -0.3), strict=True):
        axes, bar = figure.axes
        (image,) = axes.images
        assert image.get_clim() == pytest.approx((-1.0, 1.0))
        np.testing.assert_allclose(image.get_array(), value)
        assert "true height [mm]" in bar.get_ylabel()
    assert PictureScale.of([small], 0.0).span == pytest.approx(0.5e-3)
    nothing = PictureScale.of([errors_of(np.full((2, 3), np.nan))], 0.0)
    assert 0.0 < nothing.span <= 2e-9


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("draw", [draw_errors, draw_causes])
def test_pictures_have_one_orientation(
    drawn: list[Figure], tmp_path: Path, draw: Any, mirrored: bool, backward: bool
) -> None:
    """g increases to the right and the transport upwards, also for a sensor that reads from the other side."""
    errors = np.zeros((5, 7))
    errors[4, 0] = 1e-3
    draw(tmp_path / "a.png", errors_of(errors, mirrored=mirrored), "part", PictureScale(1e-3, 1e-5), backward=backward)
    assert [*drawn[0].get_size_inches(), drawn[0].dpi] == [8.0, 5.5, 150]
    (axes,) = (each for each in drawn[0].axes if each.images)
    (image,) = axes.images
    # Place of sample 0 of profile 4 on the page.
    x, y = axes.transAxes.inverted().transform(axes.transData.transform((0, 4)))
    assert (x > 0.5, y > 0.5) == (mirrored, not backward)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("sample", "profile")
    assert np.ptp(axes.get_xlim()) == pytest.approx(7.0)
    assert np.ptp(axes.get_ylim()) == pytest.approx(5.0)
    # The array is in the order of samples and profiles, and the axes of the picture turn it.
    assert not np.array_equal(np.asarray(image.get_array())[4, 0], np.asarray(image.get_array())[4, 1])
    left, right, bottom, top = image.get_extent()
    assert (left, right, bottom, top) == (-0.5, 6.5, -0.5, 4.5)


def test_a_cause_has_the_same_colour_in_every_picture(drawn: list[Figure], tmp_path: Path) -> None:
    error = np.full((3, 4), 1e-3)
    for number, causes in enumerate((("shape", "secondary"), ("secondary",), ("shape", "occlusion", "secondary"))):
        draw_causes(tmp_path / f"{number}.png", errors_of(error, causes=causes), "part", PictureScale(1e-3, 1e-5))
    colours = [np.asarray(figure.axes[0].images[0].get_array())[0, 0, :3] for figure in drawn]
    for colour in colours:
        np.testing.assert_allclose(colour, colours[0])
    others = ("shape", "occlusion", "reflectivity", "specular", "secondary", "ambient", "noise", "mirrors")
    found = set()
    for name in others:
        draw_causes(tmp_path / f"{name}.png", errors_of(error, causes=(name,)), "part", PictureScale(1e-3, 1e-5))
        found.add(tuple(np.asarray(drawn[-1].axes[0].images[0].get_array())[0, 0, :3]))
    assert len(found) == len(others)
    assert not found & {to_rgb("#4b5563"), to_rgb("#e5e7eb")}


@pytest.mark.parametrize(("below", "span"), [(979, 2e-3), (981, 1e-3)])
def test_two_percent_of_the_errors_are_beyond_half_the_scale(below: int, span: float) -> None:
    """Of a thousand errors some are 0.9 mm, the others 1.1 mm: the scale is a round length, up to twice their end."""
    error = np.full(1000, -0.9e-3)
    error[below:] = 1.1e-3
    parts = [errors_of(each.reshape(-1, 5)) for each in np.split(error, [400])]
    assert PictureScale.of(parts, 3e-6) == (pytest.approx(span), 3e-6)


def test_the_legend_states_the_part_of_each_cause(drawn: list[Figure], tmp_path: Path) -> None:
    """Eight samples: two without a reading, one within the limit, five by noise."""
    error = np.array([[np.nan, np.nan, 5e-6, 1e-3], [1e-3, 1e-3, -1e-3, 1e-3]])
    draw_causes(tmp_path / "a.png", errors_of(error), "part", PictureScale(1e-3, 12.34e-6))
    (legend,) = drawn[0].legends
    texts = [each.get_text() for each in legend.get_texts()]
    assert texts == ["no reading, or no ground truth (25.0 %)", "within 12.3 µm (12.5 %)", "noise (62.5 %)"]
    colours = [patch.get_facecolor()[:3] for patch in legend.get_patches()]
    picture = np.asarray(drawn[0].axes[0].images[0].get_array())
    for colour, place in zip(colours, ((0, 0), (0, 2), (1, 1)), strict=True):
        np.testing.assert_allclose(picture[place][:3], colour)
    assert drawn[0].axes[0].get_title(loc="left") == "part: dominant cause of each error"
