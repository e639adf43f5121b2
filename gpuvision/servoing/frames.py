"""Frames of a placement machine, and transforms between them with their covariances.

The frames of a Look-While-Place machine are the artwork F_a, the artwork where it is expected F_e, the camera F_c, the
pipette (nozzle) F_p, and the motion axes. A `Transform` maps coordinates of one frame to another one and carries both
names: a product of two transforms without a common frame in the middle is an error.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.2
   (frames of reference) and 8.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from gpuvision.matching.pose.motion import rotation
from gpuvision.validation import numbers

Float64 = npt.NDArray[np.float64]
Kind = Literal["rigid", "similarity", "affine"]
_KINDS: tuple[Kind, ...] = get_args(Kind)

ARTWORK, EXPECTED, CAMERA, PIPETTE, MOTION, IMAGE = "artwork", "expected", "camera", "pipette", "motion", "image"
"""Frames F_a, F_e, F_c, F_p of the thesis [m], the motion axes [m]; and the image [px]."""

# Rounding of float64 in a matrix whose entries were computed by some products; relative to its largest entry.
_ROUNDING = 1e-9


class MappedPoints(NamedTuple):
    """Points in the target frame of a transform.

    Attributes
    ----------
    points : numpy.ndarray
        Positions (..., 2).
    covariance : numpy.ndarray
        Covariance (..., 2, 2) of each point.
    """

    points: Float64
    covariance: Float64


@dataclass(frozen=True, kw_only=True, eq=False)
class Transform:
    """Affine transform in the plane from one named frame to another, with the covariance of its elements.

    Make one with `rigid`, `similarity` or `affine`. ``second @ first`` composes, `inverse` inverts, `apply` and
    `propagate` map points.

    Parameters
    ----------
    source, target : str
        Names of the frames: the transform maps coordinates of ``source`` to coordinates of ``target``.
    matrix : array_like
        Linear part and translation, (2, 3).
    covariance : array_like, optional
        Covariance (6, 6) of the elements of ``matrix``, row by row. Default: 0, an exact transform.
    kind : {"rigid", "similarity", "affine"}
        Group of the linear part: rotation, rotation times a scale, or any. Default: "affine".

    Raises
    ------
    ValueError
        A name is empty, a shape differs, an element is not finite, the linear part is singular or not of its kind, or
        the covariance is not symmetric and positive semidefinite.

    Notes
    -----
    Covariances are propagated to first order. Transforms are taken as independent: a product in which the same
    measured transform occurs twice has a wrong covariance. The neglected second order of a rotation by an error
    ``sigma_theta`` moves a point at the distance r by ``r sigma_theta**2 / 2``: 5e-13 m for 10 mm and 10 urad.

    Examples
    --------
    >>> camera_from_pipette = Transform.rigid("pipette", "camera", (0.02, 0.0, 0.0))
    >>> expected_from_camera = Transform.rigid("camera", "expected", (0.0, 0.001, 0.0))
    >>> (expected_from_camera @ camera_from_pipette).pose.tolist()
    [0.02, 0.001, 0.0]
    >>> camera_from_pipette @ expected_from_camera
    Traceback (most recent call last):
        ...
    ValueError: 'camera' <- 'pipette' cannot follow 'expected' <- 'camera': expected the same frame in the middle
    """

    source: str
    target: str
    matrix: Float64
    covariance: Float64 | None = None
    kind: Kind = "affine"

    __array_ufunc__ = None  # a product with an array is a TypeError, not an array of objects

    def __post_init__(self) -> None:
        if not self.source or not self.target:
            raise ValueError(f"frames are {self.source!r} and {self.target!r}, expected two names")
        if self.kind not in _KINDS:
            raise ValueError(f"kind is {self.kind!r}, expected one of {', '.join(_KINDS)}")
        matrix = _array(self.matrix, (2, 3), "matrix")
        size = float(np.max(np.abs(matrix[:, :2])))
        if not abs(np.linalg.det(matrix[:, :2])) > (_ROUNDING * size) ** 2:
            raise ValueError(f"the linear part {matrix[:, :2].tolist()} is singular, expected one that has an inverse")
        (a, b), (c, d) = matrix[:, :2]
        if self.kind != "affine" and max(abs(a - d), abs(b + c)) > _ROUNDING * size:
            raise ValueError(f"the linear part {matrix[:, :2].tolist()} is no {self.kind} transform")
        if self.kind == "rigid" and abs(math.hypot(a, c) - 1.0) > _ROUNDING:
            raise ValueError(f"the linear part has the scale {math.hypot(a, c):g}, expected 1 of a rigid transform")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "covariance", _covariance(self.covariance, 6))

    @classmethod
    def rigid(cls, source: str, target: str, pose: npt.ArrayLike, covariance: npt.ArrayLike | None = None) -> Transform:
        """Return the rigid transform (SE(2)) of a pose.

        Parameters
        ----------
        source, target : str
            Names of the frames.
        pose : array_like
            Pose (3,) of the source frame in the target frame: x, y [m], theta [rad].
        covariance : array_like, optional
            Covariance (3, 3) of the pose. Default: 0.
        """
        return _from_pose(source, target, _array(pose, (3,), "pose"), 1.0, covariance, "rigid")

    @classmethod
    def similarity(
        cls, source: str, target: str, pose: npt.ArrayLike, scale: float, covariance: npt.ArrayLike | None = None
    ) -> Transform:
        """Return the transform by a scale, then a rotation, then a translation.

        Parameters
        ----------
        source, target : str
            Names of the frames.
        pose : array_like
            Translation and angle, (3,): x, y [m], theta [rad].
        scale : float
            Length in the target frame of a unit length of the source frame, above 0.
        covariance : array_like, optional
            Covariance (4, 4) of x, y, theta and scale. Default: 0.
        """
        if not 0.0 < scale < math.inf:
            raise ValueError(f"scale is {scale}, expected a number above 0")
        return _from_pose(source, target, _array(pose, (3,), "pose"), float(scale), covariance, "similarity")

    @classmethod
    def affine(
        cls, source: str, target: str, matrix: npt.ArrayLike, covariance: npt.ArrayLike | None = None
    ) -> Transform:
        """Return the transform of a matrix (2, 3) with the covariance (6, 6) of its elements, row by row."""
        given = None if covariance is None else _covariance(covariance, 6)
        return cls(source=source, target=target, matrix=_array(matrix, (2, 3), "matrix"), covariance=given)

    @property
    def linear(self) -> Float64:
        """Linear part (2, 2)."""
        return self.matrix[:, :2]

    @property
    def translation(self) -> Float64:
        """Position (2,) of the origin of the source frame in the target frame."""
        return self.matrix[:, 2]

    @property
    def scale(self) -> float:
        """Scale of a rigid (1) or similarity transform; of an affine one the scale of the nearest similarity.

        Raises
        ------
        ValueError
            The transform reflects: its determinant is below 0, and no similarity is near.
        """
        return math.hypot(*self._nearest)

    @property
    def pose(self) -> Float64:
        """Pose (3,): translation [m] and angle [rad] of the source frame in the target frame.

        Of an affine transform the angle of the nearest similarity.

        Raises
        ------
        ValueError
            The transform reflects, as in `scale`.
        """
        along, across = self._nearest
        return np.array([*self.translation, math.atan2(across, along)])

    @property
    def pose_covariance(self) -> Float64:
        """Covariance (3, 3) of `pose`; it raises the same error."""
        return self._pose_rows[:3] @ self._elements_covariance @ self._pose_rows[:3].T

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of `scale`; it raises the same error."""
        row = self._pose_rows[3]
        return math.sqrt(max(float(row @ self._elements_covariance @ row), 0.0))

    @property
    def _elements_covariance(self) -> Float64:
        return np.zeros((6, 6)) if self.covariance is None else self.covariance

    @property
    def _nearest(self) -> tuple[float, float]:
        """Scale times cosine and sine of the angle, of the nearest similarity."""
        (a, b), (c, d) = self.linear
        if a * d - b * c < 0.0:
            raise ValueError(f"{self.target!r} <- {self.source!r} reflects, expected a transform with a pose and scale")
        return float(0.5 * (a + d)), float(0.5 * (c - b))

    @property
    def _pose_rows(self) -> Float64:
        """Derivatives (4, 6) of x, y, theta and the scale by the elements."""
        along, across = self._nearest
        square, scale = along**2 + across**2, math.hypot(along, across)
        to_along = np.array([0.5, 0.0, 0.0, 0.0, 0.5, 0.0])
        to_across = np.array([0.0, -0.5, 0.0, 0.5, 0.0, 0.0])
        theta = (along * to_across - across * to_along) / square
        return np.stack([np.eye(6)[2], np.eye(6)[5], theta, (along * to_along + across * to_across) / scale])

    def __matmul__(self, first: Transform) -> Transform:
        """Return the transform that applies ``first``, then this one.

        Raises
        ------
        ValueError
            The target of ``first`` is not the source of this transform.
        """
        if not isinstance(first, Transform):
            return NotImplemented
        if first.target != self.source:
            raise ValueError(
                f"{self.target!r} <- {self.source!r} cannot follow {first.target!r} <- {first.source!r}: expected the "
                "same frame in the middle"
            )
        product = self.linear @ first.matrix
        product[:, 2] += self.translation
        # d(A B) = dA B + A dB for the (3, 3) matrices A, B: each row of dA times B, and A times each column of dB.
        by_self = np.kron(np.eye(2), _square(first.matrix).T)
        by_first = np.kron(self.linear, np.eye(3))
        covariance = by_self @ self._elements_covariance @ by_self.T
        covariance = covariance + by_first @ first._elements_covariance @ by_first.T
        kind = _KINDS[max(_KINDS.index(self.kind), _KINDS.index(first.kind))]
        return Transform(source=first.source, target=self.target, matrix=product, covariance=covariance, kind=kind)

    def inverse(self) -> Transform:
        """Return the transform from ``target`` to ``source``."""
        inverted: Float64 = np.asarray(np.linalg.inv(_square(self.matrix))[:2], np.float64)
        # d(A^-1) = -A^-1 dA A^-1
        rows = np.kron(-inverted[:, :2], _square(inverted).T)
        covariance = rows @ self._elements_covariance @ rows.T
        return Transform(source=self.target, target=self.source, matrix=inverted, covariance=covariance, kind=self.kind)

    def apply(self, points: npt.ArrayLike) -> Float64:
        """Return points (..., 2) of the source frame in the target frame."""
        return np.asarray(np.asarray(points, np.float64) @ self.linear.T + self.translation)

    def propagate(self, points: npt.ArrayLike, covariance: npt.ArrayLike | None = None) -> MappedPoints:
        """Map points with the covariance of the points and of the transform.

        Parameters
        ----------
        points : array_like
            Positions (..., 2) in the source frame.
        covariance : array_like, optional
            Covariance (..., 2, 2) of each point. Default: 0.

        Returns
        -------
        MappedPoints
            Points, and the covariance of each point. Errors of the transform are common to all points.
        """
        given = np.asarray(points, np.float64)
        lifted = np.concatenate([given, np.ones((*given.shape[:-1], 1))], axis=-1)
        rows = np.zeros((*given.shape[:-1], 2, 6))
        rows[..., 0, :3] = rows[..., 1, 3:] = lifted
        spread = rows @ self._elements_covariance @ rows.swapaxes(-1, -2)
        if covariance is not None:
            spread = spread + self.linear @ np.asarray(covariance, np.float64) @ self.linear.T
        return MappedPoints(self.apply(given), np.asarray(spread))


def placement_error(
    pipette_in_camera: Transform, expected_in_camera: Transform, artwork_in_expected: Transform
) -> Transform:
    """Return the target of a placement as the pipette sees it: ``(Fc_Fp)^-1 Fc_Fe Fe_Fa``.

    Parameters
    ----------
    pipette_in_camera : Transform
        From "pipette" to "camera": the calibrated nozzle axis (Fc_Fp).
    expected_in_camera : Transform
        From "expected" to "camera": where the rulers were placed (Fc_Fe).
    artwork_in_expected : Transform
        From "artwork" to "expected": the measured deviation of the artwork (Fe_Fa). The artwork's origin is the
        placement point.

    Returns
    -------
    Transform
        From "artwork" to "pipette". Its pose is the move that the pipette still has to make, in pipette axes; its
        covariance is the uncertainty of the placement.

    Raises
    ------
    ValueError
        The frames do not form the chain.
    """
    chain = pipette_in_camera.inverse() @ expected_in_camera @ artwork_in_expected
    if (chain.source, pipette_in_camera.target, artwork_in_expected.target, chain.target) != (
        ARTWORK,
        CAMERA,
        EXPECTED,
        PIPETTE,
    ):
        raise ValueError(
            f"the chain leads from {chain.source!r} over {artwork_in_expected.target!r} and "
            f"{pipette_in_camera.target!r} to {chain.target!r}, expected artwork, expected, camera, pipette"
        )
    return chain


def compose_poses(outer: Float64, inner: Float64) -> Float64:
    """Compose poses: return the poses (..., 3) of the inner frames in the base frame.

    Parameters
    ----------
    outer : numpy.ndarray
        (..., 3): x, y [m] and theta [rad] of the outer frames in the base frame.
    inner : numpy.ndarray
        (..., 3): x, y [m] and theta [rad] of the inner frames in the outer frames.
    """
    c, s = np.cos(outer[..., 2]), np.sin(outer[..., 2])
    x, y, theta = np.moveaxis(inner, -1, 0)
    moved = (outer[..., 0] + c * x - s * y, outer[..., 1] + s * x + c * y, outer[..., 2] + theta)
    return np.stack(moved, axis=-1)


def invert_pose(pose: Float64) -> Float64:
    """Return the inverse of poses (..., 3): the pose of the base frame in the frame with the given pose."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y, theta = np.moveaxis(pose, -1, 0)
    return np.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)


def pose_difference(pose: Float64, other: Float64) -> Float64:
    """Return ``pose - other`` (3,), with the angle in -pi to pi."""
    difference = pose - other
    difference[2] -= 2.0 * math.pi * round(float(difference[2]) / (2.0 * math.pi))
    return difference


def move_covariance(covariance: Float64, outer: Float64, inner: Float64) -> Float64:
    """Return the covariance (3, 3) of `compose_poses` for the covariance of the outer pose and an exact inner pose."""
    x, y, _ = compose_poses(outer, inner) - outer
    rows = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    return np.asarray(rows @ covariance @ rows.T)


def _from_pose(
    source: str, target: str, pose: Float64, scale: float, covariance: npt.ArrayLike | None, kind: Kind
) -> Transform:
    """Return a rigid or similarity transform with the covariance of its parameters."""
    turned = rotation(float(pose[2]))
    matrix = np.column_stack([scale * turned, pose[:2]])
    if covariance is None:
        return Transform(source=source, target=target, matrix=matrix, kind=kind)
    given = _covariance(covariance, 3 if kind == "rigid" else 4)
    # Derivatives of the elements by x, y, theta and the scale.
    rows = np.zeros((2, 3, 4))
    rows[0, 2, 0] = rows[1, 2, 1] = 1.0
    rows[:, :2, 2] = scale * turned @ np.array([[0.0, -1.0], [1.0, 0.0]])
    rows[:, :2, 3] = turned
    by_parameter = rows.reshape(6, 4)[:, : len(given)]
    spread = by_parameter @ given @ by_parameter.T
    return Transform(source=source, target=target, matrix=matrix, covariance=spread, kind=kind)


def _square(matrix: Float64) -> Float64:
    return np.vstack([matrix, [0.0, 0.0, 1.0]])


def _array(values: npt.ArrayLike, shape: tuple[int, ...], what: str) -> Float64:
    return np.array(numbers(values, shape, what))


def _covariance(values: npt.ArrayLike | None, size: int) -> Float64:
    """Return a checked covariance; zeros for None."""
    if values is None:
        return np.zeros((size, size))
    covariance = _array(values, (size, size), "covariance")
    # Rounding relative to the standard deviations: the elements have different units.
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(deviation > 0.0, deviation, 1.0)
    normalised = covariance / unit / unit[:, None]
    symmetric = np.allclose(normalised, normalised.T, rtol=0.0, atol=_ROUNDING)
    if not symmetric or np.any(np.linalg.eigvalsh(normalised) < -_ROUNDING * size):
        raise ValueError("covariance is not symmetric and positive semidefinite")
    return np.asarray(0.5 * (covariance + covariance.T))
