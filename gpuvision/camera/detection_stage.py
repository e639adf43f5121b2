"""Pixel bandwidth that a stage of feature detection needs: search range, speed and frame rate."""

from __future__ import annotations

from dataclasses import dataclass

from gpuvision.validation import finite, integer


@dataclass(frozen=True, kw_only=True)
class DetectionStage:
    """Stage of feature detection that reads one square region of interest for each feature.

    A region holds the feature and its search range: the uncertainty of the predicted position, and the way that the
    feature moves until the next frame. A higher frame rate makes the regions smaller.

    Parameters
    ----------
    pixel : float
        Size of a pixel on the object [m], above 0; with coarse sensing the size of a coarse pixel.
    extent : float
        Side length of a feature with the surroundings that the detection needs [m], above 0.
    uncertainty : float
        Largest error of the predicted position at the time of the frame before [m], 0 or more.
    speed : float
        Largest unpredicted speed of the features [m/s], 0 or more, default 0.
    features : int
        Number of features per frame, default 1. Range: 1 or more.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 7.2.2
       and 7.2.3.
    """

    pixel: float
    extent: float
    uncertainty: float
    speed: float = 0.0
    features: int = 1

    def __post_init__(self) -> None:
        finite(self.pixel, "DetectionStage.pixel [m]", above=0.0)
        finite(self.extent, "DetectionStage.extent [m]", above=0.0)
        finite(self.uncertainty, "DetectionStage.uncertainty [m]", minimum=0.0)
        finite(self.speed, "DetectionStage.speed [m/s]", minimum=0.0)
        integer(self.features, "DetectionStage.features", minimum=1)

    def side_px(self, rate: float) -> float:
        """Return the side length of a region [px] at a frame rate [Hz]."""
        frame = 1.0 / finite(rate, "rate [Hz]", above=0.0)
        return (self._still + 2.0 * self.speed * frame) / self.pixel

    def pixel_bandwidth(self, rate: float) -> float:
        """Return the pixels per second that the stage reads at a frame rate [Hz]."""
        return self.features * self.side_px(rate) ** 2 * rate

    @property
    def best_rate(self) -> float:
        """Frame rate of the least pixel bandwidth [Hz]; 0 without speed, where fewer frames always need fewer pixels.

        With a = extent + 2 uncertainty and b = 2 speed the bandwidth is rate (a + b / rate)^2 / pixel^2, which is
        least at rate = b / a.
        """
        return 2.0 * self.speed / self._still

    @property
    def minimum_pixel_bandwidth(self) -> float:
        """Least pixels per second over all frame rates: 4 a b features / pixel^2, see `best_rate`."""
        return 4.0 * self._still * 2.0 * self.speed * self.features / self.pixel**2

    @property
    def _still(self) -> float:
        """Side length of a region without motion [m]."""
        return self.extent + 2.0 * self.uncertainty
