"""Check of the length unit of a part against the size of the sensor's view."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import make_sensor_view
from gpuvision.simulation.scene.scene import Scene

# Ratio of the part to the view beyond which the unit is doubted. Chosen: half of the step from millimetres to metres.
_DOUBTFUL_RATIO = math.sqrt(1000.0)


def doubt_unit(part: Scene, sensor: Sensor, unit: str, units: Mapping[str, float]) -> str | None:
    """Return a warning where another length unit of the mesh fits the sensor's view and the given one does not.

    Parameters
    ----------
    part : Scene
        The part, in metres by the given unit.
    sensor : Sensor
        A sensor with a light source.
    unit : str
        Name of the given unit.
    units : mapping of str to float
        Metres of each unit by its name. Of several units that fit, the first one is named.

    Returns
    -------
    str or None
        One line; None where the diagonals of part and view differ by less than a factor of 30, or no unit fits.
    """
    view = make_sensor_view(sensor)
    u, v = np.meshgrid(view.u_edges[[0, -1]], view.v_edges[[0, -1]])
    seen = _diagonal(np.asarray(view.points_in_sheet(u.ravel(), v.ravel())))
    size = _diagonal(part.corners.reshape(-1, 3))
    if not (size > 0.0 and 0.0 < seen < math.inf):
        return None
    misfit = {name: abs(math.log(size / units[unit] * metres / seen)) for name, metres in units.items()}
    limit = math.log(_DOUBTFUL_RATIO)
    likely = [name for name in units if misfit[name] < limit]
    if unit in likely or not likely:
        return None
    best = likely[0]
    return (
        f"the part is {size:.3g} m across with --unit {unit}, and the sensor sees {seen:.3g} m; "
        f"is the mesh in {best} (--unit {best})?"
    )


def _diagonal(points: npt.NDArray[np.float64]) -> float:
    """Return the diagonal of the bounding box of the finite points [m]."""
    finite = points[np.isfinite(points).all(axis=1)]
    return float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else 0.0
