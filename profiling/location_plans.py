"""Plans of localizations against truth: ``python -m gpuvision.profiling.location_plans``.

Each job is a camera over a random board: its pixels, blur, light and noise, a tolerance and a rate. The plan is made
from one image. The true errors are those of images of four other boards, with etch bias and displaced mask, at poses
anywhere in the search range. A plan holds if the root mean square error is at most the tolerance, if at most 5 % of the
images have no pose, and if the median time of a frame keeps up with the rate. Its cost is its time over the time of the
fastest feature set that truly meets the tolerance, among all that were tried (exhaustive search).
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.board.view_features import find_features_in_view
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.profiling.plan_outcomes import Outcome, cost_of, room_of, run_jobs
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.status import Status
from gpuvision.workflows.location_plan import LocationPlan, LocationPlanLimits
from gpuvision.workflows.planning_location import choose_features, plan_location

Float64 = npt.NDArray[np.float64]

_SIZE = (16e-3, 12e-3)  # of a board [m]
_CELL = 2e-3  # m: each cell of a board holds a trace or a pad
_BOARDS, _POSES = 4, 16  # boards of a job, and images of each
_BIAS, _DISPLACEMENT = 10e-6, 50e-6  # standard deviation of the etch bias, largest shift of the mask [m]
_MAX_REFUSED = 0.05  # fraction of the images of a job that may have no pose
_FULL_WELL = 20e3  # electrons
_HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
_LAYERS = {"copper.gbr": "top copper", "mask.gbr": "top mask"}


class Job(NamedTuple):
    """Camera over a board with known truth, and what is asked of its localization.

    Attributes
    ----------
    artwork : Artwork
        The board.
    options : dict
        Options of `plan_location`: scale, blur, expected pose.
    image : (rows, columns) uint8
        Image that the plan is made from.
    frames, poses : (n, rows, columns) uint8, (n, 3) float64
        Images of other boards, and the poses of the camera over them [m], [rad].
    tolerance : float
        Largest error of the pose, as a multiple of the smallest true one.
    rate : float
        Frame rate, as a fraction of the rate of the fastest feature set in the plan.
    """

    artwork: Artwork
    options: dict[str, Any]
    image: npt.NDArray[np.uint8]
    frames: npt.NDArray[np.uint8]
    poses: Float64
    tolerance: float
    rate: float


class Measured(NamedTuple):
    """Poses of a feature set in all images of a job.

    Attributes
    ----------
    error : float
        Root mean square error over points and images with a pose [m]; infinite without a pose.
    seconds : float
        Median time of an image [s].
    refused : float
        Fraction of the images without a pose.
    """

    error: float
    seconds: float
    refused: float


def random_board(rng: np.random.Generator) -> Artwork:
    """Return a board with a trace, a pad or a fiducial in most cells of a grid."""
    copper = ["%ADD10C,0.3*%\n%ADD11R,0.9X0.7*%\n%ADD12C,0.8*%\n"]
    mask = ["%ADD10R,1.3X1.1*%\n%ADD11C,1.7*%\n"]
    for x in np.arange(_CELL / 2, _SIZE[0], _CELL):
        for y in np.arange(_CELL / 2, _SIZE[1], _CELL):
            kind = rng.choice(["trace", "pad", "covered", "fiducial", "empty"], p=[0.5, 0.2, 0.1, 0.04, 0.16])
            centre = np.array([x, y]) + rng.uniform(-0.15e-3, 0.15e-3, 2)
            if kind == "trace":
                turn, half = rng.choice([0.0, 0.25, 0.5, 0.75]) * math.pi, rng.uniform(0.4e-3, 0.6e-3)
                along = half * np.array([math.cos(turn), math.sin(turn)])
                copper.append(f"D10*\n{_at(centre - along)}D02*\n{_at(centre + along)}D01*\n")
            elif kind != "empty":
                copper.append(f"{'D12' if kind == 'fiducial' else 'D11'}*\n{_at(centre)}D03*\n")
                if kind != "covered":
                    mask.append(f"{'D11' if kind == 'fiducial' else 'D10'}*\n{_at(centre)}D03*\n")
    with tempfile.TemporaryDirectory() as folder:
        for name, parts in zip(_LAYERS, (copper, mask), strict=True):
            Path(folder, name).write_text(_HEAD + "".join(parts) + "M02*\n")
        return read_artwork(folder, layers=_LAYERS, clearance=100e-6)


def _at(point: Float64) -> str:
    x, y = np.rint(1e9 * point).astype(int)
    return f"X{x}Y{y}"


def random_job(rng: np.random.Generator, device: Device) -> Job:
    """Draw a board, a camera, poses, a tolerance and a rate."""
    artwork = random_board(rng)
    pixel, blur_px = rng.uniform(15e-6, 30e-6), rng.uniform(0.5, 1.2)
    rows, columns = (int(each) for each in rng.integers((240, 320), (481, 641)))
    middle = np.array([*rng.uniform(0.42, 0.58, 2) * _SIZE, rng.uniform(-math.pi, math.pi)])
    shift, angle = max(100e-6, 4.0 * pixel), math.radians(0.3)  # the range of `locate_board` at a known pose
    poses = middle + rng.uniform(-1.0, 1.0, (_BOARDS, _POSES + 1, 3)) * (shift, shift, angle)
    electrons = math.exp(rng.uniform(math.log(2e3), math.log(16e3)))  # of white
    sensor = CmosSensor(
        rows=rows,
        columns=columns,
        pitch=5e-6,
        quantum_efficiency=0.5,
        gain=200.0 / electrons,
        dark_noise=rng.uniform(5.0, 50.0),
        full_well=_FULL_WELL,
        bits=8,
        dark_level=5.0,
    )
    frames = []
    for number, each in enumerate(poses):
        board = ReflectanceMap.of(
            artwork,
            pixel=pixel,
            region=np.array([(0.0, 0.0), _SIZE]),
            blur_px=blur_px,
            etch_bias=_BIAS * float(rng.normal()),
            mask_shift=tuple(rng.uniform(-_DISPLACEMENT, _DISPLACEMENT, 2)),
        )
        render = RenderBoard(board=board, shape=(rows, columns), sensor=sensor, electrons=electrons, seed=number)
        numbers = np.arange(len(each), dtype=np.uint32)
        frames.append(to_numpy(render(np.ascontiguousarray(each[:, None]), numbers, device=device).image))
    options = {
        "scale": pixel,
        "initial_pose": tuple(middle.tolist()),
        "blur_px": math.hypot(blur_px, math.sqrt(1.0 / 12.0)),
        "etch_bias_sigma": _BIAS,
        "copper": "bright",
    }
    others = np.concatenate([each[1:] for each in frames])
    tolerance, rate = math.exp(rng.uniform(math.log(0.7), math.log(6.0))), rng.uniform(0.05, 0.4)
    return Job(artwork, options, frames[0][0], others, poses[:, 1:].reshape(-1, 3), tolerance, rate)


def judge(rng: np.random.Generator, device: Device, limits: LocationPlanLimits = LocationPlanLimits()) -> Outcome:
    """Plan a random job and measure the plan against truth."""
    job = random_job(rng, device)
    try:
        free = plan_location(job.image, job.artwork, tolerance=1.0, device=device, limits=limits, **job.options)
    except ValueError:  # the features in view do not determine a pose
        return Outcome(None, math.nan)
    rate = job.rate / free.trials[0].seconds
    points = points_in_view(job, free)
    true = {each.name: measure(job, free, each.features, points, device) for each in free.trials}
    kept = {name: each for name, each in true.items() if each.refused <= _MAX_REFUSED}
    tolerance = job.tolerance * min(each.error for each in kept.values())
    meeting = {name for name, each in kept.items() if each.error <= tolerance}
    room = room_of([each.error for each in kept.values()], [each.seconds for each in kept.values()], tolerance, rate)
    try:
        plan = choose_features(free.located, free.trials, tolerance=tolerance, rate=rate, limits=limits)
    except PlanError:
        return Outcome(None, tolerance, possible=room >= 1.0, room=room)
    found = true[plan.chosen.name]
    error = found.error if found.refused <= _MAX_REFUSED else math.inf
    cost = cost_of(plan, [each for each in plan.trials if each.name in meeting])
    return Outcome(plan, tolerance, error, room >= 1.0, cost, found.seconds * rate <= 1.0, room)


def points_in_view(job: Job, plan: LocationPlan) -> Float64:
    """Return the features of the board in view of the image of a plan (n, 2) [m]: points at which errors count."""
    of = plan.located
    rulers, fiducials = find_features_in_view(job.artwork, of.view, of.features.imaging, of.features.placement)
    return np.concatenate([rulers.point, fiducials.point])


def measure(job: Job, plan: LocationPlan, features: FeatureSet, points: Float64, device: Device) -> Measured:
    """Measure a feature set on the images with known poses.

    An error is the distance between a point (n, 2) [m] and the point that the found pose has at its place in the image.
    """
    located = plan.located
    bound = features.bind(
        device,
        job.image.shape,
        job.image.dtype,
        copper="bright",
        threshold=located.threshold,
        noise=located.noise,
        pixel_size=job.options["scale"],
        blur_px=job.options["blur_px"],
        etch_bias_sigma=job.options["etch_bias_sigma"],
    )
    squares, times = [], []
    for frame, pose in zip(job.frames, job.poses, strict=True):
        start = time.perf_counter()
        found = bound(frame, job.options["initial_pose"])
        times.append(time.perf_counter() - start)
        if int(to_numpy(found.status)) not in (Status.OK, Status.NOT_CONVERGED):
            continue
        true, measured = (_view(job, each) for each in (pose, np.asarray(to_numpy(found.pose), np.float64)))
        away = measured.to_plane(true.to_pixels(points)) - points
        squares.append(float(np.mean(np.sum(away**2, axis=1))))
    error = math.sqrt(statistics.fmean(squares)) if squares else math.inf
    return Measured(error, statistics.median(times), 1.0 - len(squares) / len(times))


def _view(job: Job, pose: Float64) -> BoardView:
    x, y, theta = pose.tolist()
    return BoardView(scale=job.options["scale"], shape=job.image.shape, pose=(x, y, theta))


if __name__ == "__main__":
    raise SystemExit(run_jobs(judge, (__doc__ or "").partition("\n\n")[2]))
