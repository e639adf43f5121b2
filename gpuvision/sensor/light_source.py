"""Light source and electronics of a sensor, table ``[light]`` of its file: the input of a simulation beyond a scan's.

==============  ======================================================================================================
``lens``        position of the pinhole in the scene [m]; not needed with a triangulation from baseline and stand-off
``aperture``    diameter of the lens aperture [m]
``power``       power of the sheet of light per metre of G [W/m]
``thickness``   standard deviation of the light across the sheet [m]; 0: thin
``source``      (G, H) of the source of a fan [m]; default: parallel light
``width``       lowest and highest lit G [m]; default: all
``profile``     rows (G [m], factor on the power at this G)
``sub_sheets``  number of thin sheets that represent a thick one
``blur``        standard deviation of a point's image along u [sensor unit]
``bins``        PSD: number of parts of a strip in which light is collected (a camera has its pixels)
``nodes``       rays per bin along u and along v, for indirect light
``patch_size``  largest edge of the patches for multi-bounce light [m]; default: a sixteenth of the scene's diagonal
==============  ======================================================================================================

Electronics:

==================  ==================================================================================================
``responsivity``    A/W
``ambient``         ambient light on every strip or pixel [W]; for a PSD also the default of ``psd.noise.background``
``modulated``       PSD: the light is modulated, so that ambient light adds only noise
``exposure``        camera: exposure time of a frame [s]
``full_well``       camera: electrons at the highest grey level
``read_noise``      camera: read noise [electrons]
==================  ==================================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass

from gpuvision.ranging.sheet_motion import Vector
from gpuvision.schema import Section


@dataclass(frozen=True, kw_only=True)
class Light:
    """Light source and electronics of a sensor; the module documentation describes the fields.

    Attributes
    ----------
    lens, aperture, power, thickness, source, width, profile, sub_sheets, blur, bins, nodes, patch_size
        The sheet of light and the optics.
    responsivity, ambient, modulated, exposure, full_well, read_noise
        The electronics.
    """

    lens: Vector | None = None
    aperture: float
    power: float
    thickness: float = 0.0
    source: tuple[float, float] | None = None
    width: tuple[float, float] | None = None
    profile: tuple[tuple[float, ...], ...] | None = None
    sub_sheets: int = 1
    blur: float = 0.0
    bins: int = 64
    nodes: tuple[int, int] = (1, 1)
    patch_size: float | None = None
    responsivity: float = 0.4
    ambient: float = 0.0
    modulated: bool = False
    exposure: float = 1e-3
    full_well: float = 20_000.0
    read_noise: float = 0.0


def read_light(table: Section) -> Light:
    """Read the table ``[light]`` and check that it has no unknown key.

    Raises
    ------
    DescriptionError
        A value is missing or out of range.
    """
    lens, source = table.numbers("lens", "m", (3,), None), table.numbers("source", "m", (2,), None)
    width, nodes = table.numbers("width", "m", (2,), None), table.numbers("nodes", "", (2,), (1.0, 1.0))
    if any(each < 1 or each != int(each) for each in nodes):
        raise table.error(f"{table.dotted('nodes')} is {list(nodes)}, expected two whole numbers of at least 1")
    light = Light(
        lens=None if lens is None else (lens[0], lens[1], lens[2]),
        aperture=table.number("aperture", "m", above=0.0),
        power=table.number("power", "W/m", above=0.0),
        thickness=table.number("thickness", "m", 0.0, at_least=0.0),
        source=None if source is None else (source[0], source[1]),
        width=None if width is None else (width[0], width[1]),
        profile=table.rows("profile", "m, factor", 2, None),
        sub_sheets=table.integer("sub_sheets", 1, at_least=1),
        blur=table.number("blur", "sensor unit", 0.0, at_least=0.0),
        bins=table.integer("bins", 64, at_least=2),
        nodes=(int(nodes[0]), int(nodes[1])),
        patch_size=table.number("patch_size", "m", None, above=0.0),
        responsivity=table.number("responsivity", "A/W", 0.4, above=0.0),
        ambient=table.number("ambient", "W", 0.0, at_least=0.0),
        modulated=table.choice("modulated", ("yes", "no"), "no") == "yes",
        exposure=table.number("exposure", "s", 1e-3, above=0.0),
        full_well=table.number("full_well", "electrons", 20_000.0, above=0.0),
        read_noise=table.number("read_noise", "electrons", 0.0, at_least=0.0),
    )
    table.finish()
    return light
