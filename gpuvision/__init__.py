"""Range imaging and visual servoing in OpenCL.

Describe an operation once, then call it::

    import gpuvision as gv

    readout = gv.PsdReadout(strip_length=6e-3)
    reading = readout(currents)  # NumPy in, NumPy out

or bind it to a device and a shape for the hot path, or stream frames through it with a `Pipeline`.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

# In a checkout the packages `host`, `kernels` and `profiling` lie beside this folder; a wheel has them inside it.
# Extending the search path makes `import gpuvision.host` work when Python starts in the repository's root.
if not os.path.isdir(os.path.join(__path__[0], "host")):
    __path__.append(os.path.dirname(__path__[0]))

if TYPE_CHECKING:
    from gpuvision.camera.camera import Camera
    from gpuvision.camera.image_map import PixelMap
    from gpuvision.camera.lens import Lens
    from gpuvision.camera.lens_known import fit_tilt
    from gpuvision.camera.lines.lens_fit import LensFit
    from gpuvision.camera.lines.line_families import grid_lines
    from gpuvision.camera.patterns.chessboard import find_chessboard
    from gpuvision.camera.patterns.dots import find_dots
    from gpuvision.camera.patterns.line_pattern import find_lines
    from gpuvision.camera.patterns.pattern import PatternGrid
    from gpuvision.camera.planar_views import fit_camera
    from gpuvision.camera.polynomial import PlanePolynomial
    from gpuvision.camera.scheimpflug import TiltedSensor
    from gpuvision.camera.tsai import fit_tsai
    from gpuvision.camera.undistort_image import UndistortedImage, UndistortImage
    from gpuvision.camera.undistort_points import UndistortedPoints, UndistortPoints
    from gpuvision.camera.vanishing_points import fit_lens, straightness_px
    from gpuvision.camera.views.camera_fit import CameraFit
    from gpuvision.camera.views.target_views import view_of
    from gpuvision.features import FeatureSet, choose_features, read_features
    from gpuvision.field_file import read_field
    from gpuvision.host import Device, GpuVisionError, Pipeline, Step, host_view, open_recording
    from gpuvision.locate import LocatedBoard, locate_board
    from gpuvision.locate_field import LocatedRobot, floor_points, locate_robot, scan_floor
    from gpuvision.matching.artwork import Artwork, read_artwork
    from gpuvision.matching.blob import Blobs, FindBlobs
    from gpuvision.matching.field import Candidate, RefinePoses, SearchField
    from gpuvision.matching.field_map import Field, FieldMap
    from gpuvision.matching.line_fit import FitLines, LineFits
    from gpuvision.matching.local_fix import Fix, LocalFix, lay_rulers
    from gpuvision.matching.odometry import PoseEstimate
    from gpuvision.matching.pose import BoardPose, SolvePose, line_rows, point_rows
    from gpuvision.matching.registration import FirstFix, Registration, board_fix, register
    from gpuvision.matching.ruler import Edges, RulerEdges, best_smoothing
    from gpuvision.matching.selection import Imaging, Selection
    from gpuvision.ranging.line import LineReading, LineReadout
    from gpuvision.ranging.psd import PsdNoise, PsdReading, PsdReadout
    from gpuvision.ranging.range_image import RangeImage, RangePoints, RotatingSheet, StraightTransport
    from gpuvision.ranging.regrid import Grid, HeightMap, Regrid
    from gpuvision.ranging.triangulation import SampleAxes, SheetPoints, Triangulation
    from gpuvision.simulation.artifacts import Artifacts, explain
    from gpuvision.simulation.bounces import Bounces
    from gpuvision.simulation.camera_simulator import CameraSimulator
    from gpuvision.simulation.illumination import LightSheet
    from gpuvision.simulation.light_paths import LightPaths
    from gpuvision.simulation.line_irradiance import LineIrradiance, LitSegments
    from gpuvision.simulation.masks import Mask, optimise_mask
    from gpuvision.simulation.material import Material
    from gpuvision.simulation.psd_simulator import PsdSimulator
    from gpuvision.simulation.rays import AnyHit, ClosestHit
    from gpuvision.simulation.recommendations import DualSensor
    from gpuvision.simulation.reflectance import Ggx, Lambert, OrenNayar, Phong, Reflectance, Ward
    from gpuvision.simulation.scene import Scene
    from gpuvision.simulation.sight import Sight
    from gpuvision.simulation.visible_light import VisibleLight
    from gpuvision.status import Status

# Names come with their first use: the command is there at once, and an interrupt while it loads is not a stack trace.
_PLACES = {
    "AnyHit": "gpuvision.simulation.rays",
    "Artifacts": "gpuvision.simulation.artifacts",
    "Artwork": "gpuvision.matching.artwork",
    "Blobs": "gpuvision.matching.blob",
    "BoardPose": "gpuvision.matching.pose",
    "Bounces": "gpuvision.simulation.bounces",
    "Camera": "gpuvision.camera.camera",
    "CameraFit": "gpuvision.camera.views.camera_fit",
    "CameraSimulator": "gpuvision.simulation.camera_simulator",
    "Candidate": "gpuvision.matching.field",
    "ClosestHit": "gpuvision.simulation.rays",
    "Device": "gpuvision.host",
    "DualSensor": "gpuvision.simulation.recommendations",
    "Edges": "gpuvision.matching.ruler",
    "FeatureSet": "gpuvision.features",
    "Field": "gpuvision.matching.field_map",
    "FieldMap": "gpuvision.matching.field_map",
    "FindBlobs": "gpuvision.matching.blob",
    "FirstFix": "gpuvision.matching.registration",
    "FitLines": "gpuvision.matching.line_fit",
    "Fix": "gpuvision.matching.local_fix",
    "Ggx": "gpuvision.simulation.reflectance",
    "GpuVisionError": "gpuvision.host",
    "Grid": "gpuvision.ranging.regrid",
    "HeightMap": "gpuvision.ranging.regrid",
    "Imaging": "gpuvision.matching.selection",
    "Lambert": "gpuvision.simulation.reflectance",
    "Lens": "gpuvision.camera.lens",
    "LensFit": "gpuvision.camera.lines.lens_fit",
    "LightPaths": "gpuvision.simulation.light_paths",
    "LightSheet": "gpuvision.simulation.illumination",
    "LineFits": "gpuvision.matching.line_fit",
    "LineIrradiance": "gpuvision.simulation.line_irradiance",
    "LineReading": "gpuvision.ranging.line",
    "LineReadout": "gpuvision.ranging.line",
    "LitSegments": "gpuvision.simulation.line_irradiance",
    "LocalFix": "gpuvision.matching.local_fix",
    "LocatedBoard": "gpuvision.locate",
    "LocatedRobot": "gpuvision.locate_field",
    "Mask": "gpuvision.simulation.masks",
    "Material": "gpuvision.simulation.material",
    "OrenNayar": "gpuvision.simulation.reflectance",
    "PatternGrid": "gpuvision.camera.patterns.pattern",
    "Phong": "gpuvision.simulation.reflectance",
    "Pipeline": "gpuvision.host",
    "PixelMap": "gpuvision.camera.image_map",
    "PlanePolynomial": "gpuvision.camera.polynomial",
    "PoseEstimate": "gpuvision.matching.odometry",
    "PsdNoise": "gpuvision.ranging.psd",
    "PsdReading": "gpuvision.ranging.psd",
    "PsdReadout": "gpuvision.ranging.psd",
    "PsdSimulator": "gpuvision.simulation.psd_simulator",
    "RangeImage": "gpuvision.ranging.range_image",
    "RangePoints": "gpuvision.ranging.range_image",
    "RefinePoses": "gpuvision.matching.field",
    "Reflectance": "gpuvision.simulation.reflectance",
    "Registration": "gpuvision.matching.registration",
    "Regrid": "gpuvision.ranging.regrid",
    "RotatingSheet": "gpuvision.ranging.range_image",
    "RulerEdges": "gpuvision.matching.ruler",
    "SampleAxes": "gpuvision.ranging.triangulation",
    "Scene": "gpuvision.simulation.scene",
    "SearchField": "gpuvision.matching.field",
    "Selection": "gpuvision.matching.selection",
    "SheetPoints": "gpuvision.ranging.triangulation",
    "Sight": "gpuvision.simulation.sight",
    "SolvePose": "gpuvision.matching.pose",
    "Status": "gpuvision.status",
    "Step": "gpuvision.host",
    "StraightTransport": "gpuvision.ranging.range_image",
    "TiltedSensor": "gpuvision.camera.scheimpflug",
    "Triangulation": "gpuvision.ranging.triangulation",
    "UndistortImage": "gpuvision.camera.undistort_image",
    "UndistortPoints": "gpuvision.camera.undistort_points",
    "UndistortedImage": "gpuvision.camera.undistort_image",
    "UndistortedPoints": "gpuvision.camera.undistort_points",
    "VisibleLight": "gpuvision.simulation.visible_light",
    "Ward": "gpuvision.simulation.reflectance",
    "best_smoothing": "gpuvision.matching.ruler",
    "board_fix": "gpuvision.matching.registration",
    "choose_features": "gpuvision.features",
    "explain": "gpuvision.simulation.artifacts",
    "find_chessboard": "gpuvision.camera.patterns.chessboard",
    "find_dots": "gpuvision.camera.patterns.dots",
    "find_lines": "gpuvision.camera.patterns.line_pattern",
    "fit_camera": "gpuvision.camera.planar_views",
    "fit_lens": "gpuvision.camera.vanishing_points",
    "fit_tilt": "gpuvision.camera.lens_known",
    "fit_tsai": "gpuvision.camera.tsai",
    "floor_points": "gpuvision.locate_field",
    "grid_lines": "gpuvision.camera.lines.line_families",
    "host_view": "gpuvision.host",
    "lay_rulers": "gpuvision.matching.local_fix",
    "line_rows": "gpuvision.matching.pose",
    "locate_board": "gpuvision.locate",
    "locate_robot": "gpuvision.locate_field",
    "open_recording": "gpuvision.host",
    "optimise_mask": "gpuvision.simulation.masks",
    "point_rows": "gpuvision.matching.pose",
    "read_artwork": "gpuvision.matching.artwork",
    "read_features": "gpuvision.features",
    "read_field": "gpuvision.field_file",
    "register": "gpuvision.matching.registration",
    "scan_floor": "gpuvision.locate_field",
    "straightness_px": "gpuvision.camera.vanishing_points",
    "view_of": "gpuvision.camera.views.target_views",
}

__all__ = [
    "AnyHit",
    "Artifacts",
    "Artwork",
    "Blobs",
    "BoardPose",
    "Bounces",
    "Camera",
    "CameraFit",
    "CameraSimulator",
    "Candidate",
    "ClosestHit",
    "Device",
    "DualSensor",
    "Edges",
    "FeatureSet",
    "Field",
    "FieldMap",
    "FindBlobs",
    "FirstFix",
    "FitLines",
    "Fix",
    "Ggx",
    "GpuVisionError",
    "Grid",
    "HeightMap",
    "Imaging",
    "Lambert",
    "Lens",
    "LensFit",
    "LightPaths",
    "LightSheet",
    "LineFits",
    "LineIrradiance",
    "LineReading",
    "LineReadout",
    "LitSegments",
    "LocalFix",
    "LocatedBoard",
    "LocatedRobot",
    "Mask",
    "Material",
    "OrenNayar",
    "PatternGrid",
    "Phong",
    "Pipeline",
    "PixelMap",
    "PlanePolynomial",
    "PoseEstimate",
    "PsdNoise",
    "PsdReading",
    "PsdReadout",
    "PsdSimulator",
    "RangeImage",
    "RangePoints",
    "RefinePoses",
    "Reflectance",
    "Registration",
    "Regrid",
    "RotatingSheet",
    "RulerEdges",
    "SampleAxes",
    "Scene",
    "SearchField",
    "Selection",
    "SheetPoints",
    "Sight",
    "SolvePose",
    "Status",
    "Step",
    "StraightTransport",
    "TiltedSensor",
    "Triangulation",
    "UndistortImage",
    "UndistortPoints",
    "UndistortedImage",
    "UndistortedPoints",
    "VisibleLight",
    "Ward",
    "best_smoothing",
    "board_fix",
    "choose_features",
    "explain",
    "find_chessboard",
    "find_dots",
    "find_lines",
    "fit_camera",
    "fit_lens",
    "fit_tilt",
    "fit_tsai",
    "floor_points",
    "grid_lines",
    "host_view",
    "lay_rulers",
    "line_rows",
    "locate_board",
    "locate_robot",
    "open_recording",
    "optimise_mask",
    "point_rows",
    "read_artwork",
    "read_features",
    "read_field",
    "register",
    "scan_floor",
    "straightness_px",
    "view_of",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
