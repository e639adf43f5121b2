"""Reference of board poses: rulers selected from artwork and placed in simulated images, and poses of many images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from board_images import BoardPicture, View
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import Polarity, RulerEdges
from gpuvision.matching.features.selection import Selection, predict_selection, select_rulers
from gpuvision.matching.pose.board_pose import BoardPoseEstimator, place_rulers
from gpuvision.matching.pose.pose import SolvePose

Float64 = npt.NDArray[np.float64]

PIXEL, NOISE, SHAPE = 25e-6, 2.0, (480, 640)
SHIFT, ANGLE = 80e-6, 4e-3  # largest offset of the boards; the search range is 100 um and 5 mrad
GROSS = 40.0  # squared Mahalanobis distance that three Gaussian numbers exceed with a probability of 1e-8
KINDS = ("missing", "outliers", "motion", "reversed")


class Fixes(NamedTuple):
    """Poses of n images: errors (n, 3) about the placement point, covariances (NaN where refused), and status."""

    errors: Float64
    covariances: Float64
    status: npt.NDArray[np.uint8]

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        return self.status == 0

    @property
    def squares(self) -> Float64:
        """Squared Mahalanobis distances (accepted,) of the errors, with the covariance of each pose."""
        found = self.errors[self.good]
        return np.asarray(np.einsum("bi,bij,bj->b", found, np.linalg.inv(self.covariances[self.good]), found))

    @property
    def predicted(self) -> Float64:
        """Mean predicted standard deviations (3,)."""
        return np.asarray(np.sqrt(np.mean(self.covariances[self.good][:, [0, 1, 2], [0, 1, 2]], axis=0)))

    @property
    def scatter(self) -> Float64:
        """Standard deviations (3,) of the errors about 0."""
        return np.asarray(np.sqrt(np.mean(self.errors[self.good] ** 2, axis=0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardFix:
    """Board, the part of it in view of a camera, and rulers on single edges there.

    Parameters
    ----------
    artwork, middle
        Board in view, and the point [m] about which it rotates, which is also the placement point.
    budget
        Number of rulers.
    motion_px
        Length of the motion blur along the rows, which the imaging model also expects.
    max_leverage
        As in `SolvePose`.
    """

    artwork: Artwork
    middle: tuple[float, float]
    budget: int = 40
    motion_px: float = 0.0
    max_leverage: float = 0.95

    @classmethod
    def drawn(cls, folder: Path) -> BoardFix:
        """Return traces in four directions and uncovered pads, 16 mm x 12 mm, and a frame of silk."""
        head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"

        def at(x: float, y: float, how: str) -> str:
            return f"X{round(x * 1e6)}Y{round(y * 1e6)}{how}*\n"

        copper, mask = head + "%ADD10C,0.4*%\n%ADD11R,1.4X1.0*%\nD10*\n", head + "%ADD11R,1.8X1.4*%\nD11*\n"
        for x, y in ((1, 2), (5.2, 2), (9.4, 2), (1, 10.2), (5.2, 10.2), (9.4, 10.2)):
            copper += at(x, y, "D02") + at(x + 2.5, y, "D01")
        for x, y in ((1.5, 3.6), (13.2, 3.6), (3.2, 6.2), (12.4, 6.6)):
            copper += at(x, y, "D02") + at(x, y + 2.2, "D01")
        for x, y, sign in ((5, 3.4, 1), (8, 5.6, -1), (5.2, 6.6, 1), (9.6, 3.4, 1)):
            copper += at(x, y, "D02") + at(x + 1.8, y + 1.8 * sign, "D01")
        copper += "D11*\n"
        for x, y in ((13.5, 1.8), (13.5, 10.4), (8.6, 8.6), (2.2, 8.9)):
            copper, mask = copper + at(x, y, "D03"), mask + at(x, y, "D03")
        silk = head + "%ADD10C,0.2*%\nD10*\n" + at(0.2, 0.4, "D02") + at(15.5, 0.4, "D01") + at(15.5, 11.6, "D01")
        (folder / "copper.gbr").write_text(copper + "M02*\n")
        (folder / "mask.gbr").write_text(mask + "M02*\n")
        (folder / "silk.gbr").write_text(silk + "M02*\n")
        layers = {r"copper\.gbr": "top copper", r"mask\.gbr": "top mask", r"silk\.gbr": "top silk"}
        return cls(artwork=read_artwork(folder, layers=layers, clearance=100e-6), middle=(8e-3, 6e-3))

    @cached_property
    def view(self) -> View:
        corner = np.array(self.middle) + (np.array(SHAPE[::-1]) - 1) / 2 * PIXEL * (-1, 1)
        return View(
            corner=(float(corner[0]), float(corner[1])),
            pixel=PIXEL,
            shape=SHAPE,
            noise=NOISE,
            motion_px=self.motion_px,
        )

    @cached_property
    def imaging(self) -> Imaging:
        """Return the image quality: steps of 50 under the mask and 110 without mask, relative to the noise."""
        return Imaging(
            pixel=PIXEL,
            blur_px=self.view.edge_blur_px,
            motion_px=(self.motion_px, 0.0),
            contrast_bare=110 / NOISE,
            contrast_masked=50 / NOISE,
        )

    @cached_property
    def rulers(self) -> FeatureCandidates:
        half = (np.array(SHAPE[::-1]) / 2 - 30) * PIXEL
        found = find_ruler_candidates(self.artwork, (self.middle - half, self.middle + half), self.middle, self.imaging)
        keep = ~found.pair & (found.ambiguity == 0)
        return FeatureCandidates(*(each[keep] for each in found[:-1]), found.placement)

    @cached_property
    def chosen(self) -> Selection:
        return select_rulers(self.rulers, self.imaging, self.budget, per_source=8)

    def at_random(self, rng: np.random.Generator) -> Selection:
        """Return random rulers, equal in number to the selected ones, that determine a pose."""
        while True:
            try:
                some = rng.choice(len(self.rulers.sigma), len(self.chosen.chosen), replace=False)
                return predict_selection(self.rulers, self.imaging, some)
            except ValueError:
                continue

    def fixes(
        self,
        pictures: Sequence[BoardPicture],
        draws: int,
        device: Device,
        rng: np.random.Generator,
        *,
        selection: Selection | None = None,
        polarity: Polarity = "falling",
    ) -> Fixes:
        """Return poses of boards anywhere within the search range, image by image, in 8 bits."""
        which = (selection or self.chosen).chosen
        normal, point = self.rulers.normal[which], self.rulers.point[which] - self.middle
        per, (x, y) = 1 / PIXEL, np.array(self.view.corner) - self.middle
        matrix = np.array([[per, 0.0, -x * per], [0.0, -per, y * per], [0.0, 0.0, 1.0]])
        rulers = place_rulers(normal, point, np.zeros((len(which), 1)), matrix, etch_factor=1.0)
        ruler = RulerEdges(
            threshold=15.0,
            length=math.ceil(self.rulers.length.max() / PIXEL),
            width=self.imaging.width_px,
            smoothing_px=self.imaging.smoothing_px,
            polarity=polarity,
            noise=NOISE,
        )
        # Offsets of boards lie in a circle around the square of the search range.
        search_range = (1.5 * self.imaging.shift, 1.5 * self.imaging.angle)
        solver = SolvePose(
            etch_bias_sigma=self.imaging.etch_bias_sigma,
            max_trials=256,
            search_range=search_range,
            max_leverage=self.max_leverage,
        )
        fix = BoardPoseEstimator(ruler=ruler, lines=len(which), rulers_per_line=1, solver=solver)
        errors, covariances, status = (
            np.full((draws, 3), np.nan),
            np.full((draws, 3, 3), np.nan),
            np.empty(draws, np.uint8),
        )
        for draw in range(draws):
            pose = (*rng.uniform(-SHIFT, SHIFT, 2), rng.uniform(-ANGLE, ANGLE))
            picture = pictures[draw % len(pictures)].seen(pose, rng)
            found = fix(np.clip(np.rint(picture), 0, 255).astype(np.uint8), *rulers, device=device)
            status[draw] = found.status
            errors[draw], covariances[draw] = found.pose - pose, found.covariance
        return Fixes(errors, covariances, status)

    def sharp(self, count: int, rng: np.random.Generator) -> list[BoardPicture]:
        """Return poses of boards with a random etch bias and displaced mask and silk."""
        off = self.imaging.registration
        return [
            self.painted(
                replace(
                    self.view,
                    etch_bias=self.imaging.etch_bias_sigma * float(rng.normal()),
                    mask_shift=tuple(rng.uniform(-off, off, 2)),
                    silk_shift=tuple(rng.uniform(-off, off, 2)),
                )
            )
            for _ in range(count)
        ]

    def disturbed(self, kind: str, rng: np.random.Generator) -> BoardPicture:
        """Return poses with 30 % of the measured areas missing, 30 % of the rulers on wrong edges, or dark copper."""
        view = replace(self.view, etch_bias=self.imaging.etch_bias_sigma * float(rng.normal()))
        if kind == "reversed":
            return self.painted(replace(view, levels=(110.0, 60.0, 200.0, 90.0, 20.0, 240.0)))
        if kind == "missing":
            removed = rng.choice(self._areas, round(0.3 * len(self._areas)), replace=False)
            return self.painted(view, missing=set(removed.tolist()))
        return self.painted(view, more=self.splashes(rng) if kind == "outliers" else ())

    def painted(
        self, view: View, missing: set[int] | frozenset[int] = frozenset(), more: Sequence[Shape] = ()
    ) -> BoardPicture:
        return BoardPicture(self.artwork, view, about=self.middle, missing=missing, more=more)

    @cached_property
    def _areas(self) -> list[int]:
        """Return the copper areas with selected rulers on their borders."""
        points = self.rulers.point[self.chosen.chosen]
        return [number for number, each in enumerate(self.artwork.copper) if _near(each.outline, points).any()]

    def splashes(self, rng: np.random.Generator, share: float = 0.3) -> list[Shape]:
        """Return splashes (copper added) or bites (copper removed) that cover a share of the rulers completely."""
        points, normals = self.rulers.point[self.chosen.chosen], self.rulers.normal[self.chosen.chosen]
        # Enlarged by half the width of a ruler and by the offset of boards along their edges.
        half, seen = 6 * PIXEL, (6 + 2.6) * PIXEL + math.sqrt(2.0) * SHIFT
        hit: set[int] = set()
        shapes = []
        for index in rng.permutation(len(points)):
            normal, along = normals[index], np.array([-normals[index, 1], normals[index, 0]])
            away = points - points[index]
            is_near = (np.abs(away @ along) < seen) & (np.abs(away @ normal) < 350e-6)
            more = hit | set(np.flatnonzero(is_near).tolist())
            if len(more) > round(share * len(points)):
                continue
            hit = more
            by = rng.choice([-1.0, 1.0]) * rng.uniform(60e-6, 250e-6)
            inner, outer = points[index] - 20e-6 * np.sign(by) * normal, points[index] + by * normal
            corners = [inner - half * along, inner + half * along, outer + half * along, outer - half * along]
            shapes.append(Shape(np.array(corners), bool(by > 0)))
        return shapes


def _near(outline: Float64, points: Float64) -> npt.NDArray[np.bool_]:
    """Return which points lie on an outline, to 3 micrometres."""
    side = np.roll(outline, -1, axis=0) - outline
    away = points[:, None] - outline
    share = np.clip(np.sum(away * side, axis=-1) / np.maximum(np.sum(side**2, axis=-1), 1e-30), 0, 1)
    return np.asarray(np.min(np.linalg.norm(away - share[..., None] * side, axis=-1), axis=1) < 3e-6)
