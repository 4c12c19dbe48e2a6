"""Inference with a trained Point2WSS: from points and footprints to heights and angles.

The digits of one number are predicted independently, so their joint distribution is the product. The paper takes
the most probable digit at each place; a wrong tens digit then costs ten metres. The median of the joint
distribution has the least expected absolute error, and the distributions of several views can be averaged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from p2wss.config import DeviceName
from p2wss.config.roof_angles import FLAT_DEG, MAX_SLOPE_DEG, MIN_SLOPE_DEG, VERTICAL_DEG
from p2wss.nets import compute
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches, centre, thin
from p2wss.nets.patches import Patches
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.prediction import Prediction
from p2wss.nets.tokenizer import (
    KIND_COORDINATE,
    KIND_SIGN,
    MASK,
    MINUS,
    PLUS,
    Quantised,
    Tokenizer,
    roll_index,
)
from p2wss.nets.weights import load_model

# rows of a forward pass on a GPU
GPU_ROWS = 256
# on a GPU, where many buildings are predicted at once, rings are padded to a multiple of this number of vertices
_VERTEX_STEP = 8
# the indices of the buildings of a pass, and arrays with a row for each
_Pass = tuple[np.ndarray, tuple[np.ndarray, ...]]


def load_predictor(path: Path, device: DeviceName = "auto") -> Point2WssPredictor:
    """A trained model on ``device``; "auto" is a GPU if there is one.

    Raises :class:`InputError` for any other file, and for a device that is not available.
    """
    return Point2WssPredictor(load_model(path).to(compute.device_of(device)))


class Point2WssPredictor:
    """A trained model. Memory does not grow with the number of buildings.

    A building's prediction does not depend on the other buildings of a call, to the last bit. Matrix products round
    differently for other sizes and other numbers of threads, and sums over padded rows for other padding. So all sizes
    follow from the building itself. On a CPU each building has its own forward pass, without padding and on one thread
    (with several threads, several buildings are predicted at a time). On a GPU every pass has the same number of rows,
    padded to the most points and to a multiple of eight vertices.
    """

    def __init__(self, module: Point2Wss, num_views: int | None = None) -> None:
        """``num_views``: views of each building, whose probabilities are averaged; by default as the config says."""
        self.module = module.eval()
        self.device = next(module.parameters()).device
        self.tokenizer = module.tokenizer
        self.settings = module.config.decoding
        self.num_views = num_views or self.settings.num_rotations
        self.dvae_config = module.dvae_config
        self.max_num_vertices = module.config.max_vertices
        self.on_building = module.config.augmentation.on_building_share > 0
        self._rows_per_pass = 1 if self.device.type == "cpu" else GPU_ROWS

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        """Heights and angles from clouds (n, 3), z above the ground, and the rings of their footprints.

        x and y of cloud and rings share any local frame; the first ring is the exterior, counter-clockwise,
        without a repeated first vertex. Edges of courtyards get the median slope of the exterior's edges (paper,
        section 4.3: a sequence has one ring).

        Raises ``ValueError`` for an empty cloud or too many vertices.
        """
        exterior = [np.asarray(r[0], np.float32) for r in rings]
        self._check(points_m, exterior)
        height = np.full(len(points_m), np.nan)
        angle: list[np.ndarray] = [np.full(sum(map(len, r)), np.nan) for r in rings]
        for index, (heights, angles) in self._for_each(points_m, exterior, self._decode):
            for row, i in enumerate(index):
                num_edges = len(exterior[i])
                height[i] = heights[row]
                angle[i][:num_edges] = angles[row, :num_edges]
                if len(rings[i]) > 1:
                    angle[i][num_edges:] = _courtyard_angle(angle[i][:num_edges])
        return Prediction(height, angle)

    def reconstruct_all_masked(
        self,
        points_m: Sequence[np.ndarray],
        footprints_m: Sequence[np.ndarray],
        signs_visible: bool = True,
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Height, footprint and angles with all digits masked, as in the paper's Table 1.

        Of the footprints only the number of vertices, the order and, if ``signs_visible``, the signs of the
        centred coordinates reach the network. Arguments as in :meth:`predict`, exterior rings only. Returns
        heights (b,), footprints [(v, 2)] in the frame and vertex order of the arguments, and angles [(v,)].
        """
        exterior = [np.asarray(ring, np.float32) for ring in footprints_m]
        self._check(points_m, exterior)
        height = np.full(len(points_m), np.nan)
        xy: list[np.ndarray] = [np.full(ring.shape, np.nan) for ring in exterior]
        angle: list[np.ndarray] = [np.full(len(ring), np.nan) for ring in exterior]

        def decode(batch: Batch) -> tuple[np.ndarray, ...]:
            return *self._decode_all(batch, signs_visible), batch.xy[:, 0].numpy()

        for index, (heights, vertices, angles, first) in self._for_each(points_m, exterior, decode):
            for row, i in enumerate(index):
                num = len(exterior[i])
                # the batch is centred
                shift = exterior[i][0] - first[row]
                height[i], angle[i], xy[i] = heights[row], angles[row, :num], vertices[row, :num] + shift
        return height, xy, angle

    def _check(self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]) -> None:
        for i, (points, ring) in enumerate(zip(points_m, exterior, strict=True)):
            if not len(points):
                raise ValueError(f"building {i} has no points")
            if not 3 <= len(ring) <= self.max_num_vertices:
                raise ValueError(f"building {i} has {len(ring)} vertices, not 3 to {self.max_num_vertices}")

    def _for_each(
        self,
        points_m: Sequence[np.ndarray],
        exterior: Sequence[np.ndarray],
        decode: Callable[[Batch], tuple[np.ndarray, ...]],
    ) -> Iterator[_Pass]:
        """For each pass: the indices of its buildings, and what ``decode`` returns for its centred batch, whose first
        rows these buildings are. Buildings that the number format cannot represent are left out."""

        def run(index: np.ndarray) -> _Pass | None:
            batch = self._batch([points_m[i] for i in index], [exterior[i] for i in index])
            rows = np.flatnonzero(batch.xy.norm(dim=-1).amax(1).numpy() < self.tokenizer.reach_m)
            if not len(rows):
                return None
            if self._rows_per_pass > 1 or len(rows) < len(index):
                batch = batch[torch.from_numpy(np.resize(rows, self._rows_per_pass))]
            return index[rows], decode(batch)

        passes: list[np.ndarray] = []
        num_vertices = np.array([len(ring) for ring in exterior])
        width = self._width(num_vertices)
        for value in np.unique(width):
            indices = np.flatnonzero(width == value)
            passes += np.split(indices, range(self._rows_per_pass, len(indices), self._rows_per_pass))
        results = _map_on_single_threads(run, passes) if self.device.type == "cpu" else map(run, passes)
        yield from filter(None, results)

    def _width(self, num_vertices: np.ndarray) -> np.ndarray:
        """Numbers of vertices after padding, for each number of vertices."""
        step = 1 if self._rows_per_pass == 1 else _VERTEX_STEP
        return -(-num_vertices // step) * step

    def _batch(self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]) -> Batch:
        """A centred batch, padded according to :meth:`_width` where a pass has several rows."""
        num_points = self.dvae_config.num_points
        clouds = [points[thin(len(points), num_points)] for points in points_m]
        num_vertices = np.array([len(ring) for ring in exterior])
        width = num_points if self._rows_per_pass > 1 else max(map(len, clouds))
        points = np.zeros((len(clouds), width, 3), np.float32)
        valid = np.zeros((len(clouds), width), bool)
        xy = np.zeros((len(clouds), self._width(num_vertices).max(), 2), np.float32)
        for row, (cloud, ring) in enumerate(zip(clouds, exterior, strict=True)):
            points[row, : len(cloud)] = cloud
            valid[row, : len(cloud)] = True
            xy[row, : len(ring)] = ring
        return centre(
            Batch(
                points=torch.from_numpy(points),
                valid=torch.from_numpy(valid),
                ground_z=torch.zeros(len(clouds)),
                height=torch.zeros(len(clouds)),
                xy=torch.from_numpy(xy),
                angle=torch.zeros(xy.shape[:2]),
                num_vertices=torch.from_numpy(num_vertices),
            )
        )

    @torch.inference_mode()
    def _decode(self, batch: Batch) -> tuple[np.ndarray, ...]:
        """Heights (b,) m and angles (b, n) degrees of a centred batch whose footprints are known.

        The probabilities of the views are averaged before values are decoded.
        """
        tokenizer, mode = self.tokenizer, self.settings.mode
        batch = batch.to(self.device)
        views, patches = _views(batch, batch_patches(batch, self.dvae_config), self.num_views)
        tokens, _, back = self._sequences(views)
        heights, angles = self._distributions(
            self.module.restore(
                tokens,
                views.num_vertices,
                patches,
                views.ground_z * NETWORK_SCALE,
                tokenizer.target_positions(batch.xy.shape[1]).to(self.device),
            )
        )
        angles = angles.gather(1, back[..., None].expand_as(angles))
        heights = heights.unflatten(0, (self.num_views, -1)).mean(0)
        angles = angles.unflatten(0, (self.num_views, -1)).mean(0)
        angles = constrain(angles, self._angle_support())
        height, angle = decode(heights, mode), decode(angles, mode)
        return (
            (height * 10.0 ** tokenizer.places[-1]).cpu().numpy(),
            angle.double().cpu().numpy(),
        )

    @torch.inference_mode()
    def _decode_all(self, batch: Batch, signs_visible: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights (b,) m, vertices (b, n, 2) m and angles (b, n) degrees of a centred batch, all digits masked."""
        tokenizer, mode = self.tokenizer, self.settings.mode
        batch = batch.to(self.device)
        tokens, kind, back = self._sequences(batch)
        masked = (kind == KIND_COORDINATE) | ((kind == KIND_SIGN) & (not signs_visible))
        tokens = tokens.masked_fill(masked, MASK)
        patches = batch_patches(batch, self.dvae_config)
        for _ in range(max(self.settings.num_refinements, 1)):
            logits = self.module.restore(tokens, batch.num_vertices, patches, batch.ground_z * NETWORK_SCALE)
            xy = self._coordinates(tokenizer.blocks(tokens), tokenizer.blocks(logits))
            zero = torch.zeros_like(xy[..., 0])
            tokens, _ = tokenizer.mask_targets(Quantised(zero[:, 0], xy, zero, batch.num_vertices))
        xy_m = (xy * 10.0**-tokenizer.coord_decimals).gather(1, back[..., None].expand(-1, -1, 2))
        if self.settings.num_refinements:
            # a rotated view must be representable, too
            reach_m = xy_m.norm(dim=-1, keepdim=True).clamp(min=tokenizer.reach_m) / tokenizer.reach_m
            height_m, angle_deg = self._decode(replace(batch, xy=(xy_m / reach_m).float()))
            return height_m, xy_m.cpu().numpy(), angle_deg
        heights, angle = self._distributions(
            logits[:, tokenizer.target_positions(batch.xy.shape[1]).to(self.device)]
        )
        height = decode(heights, mode)
        angle = constrain(angle, self._angle_support())
        return (
            (height * 10.0 ** tokenizer.places[-1]).cpu().numpy(),
            xy_m.cpu().numpy(),
            decode(angle, mode).gather(1, back).double().cpu().numpy(),
        )

    def _coordinates(self, blocks: Tensor, logits: Tensor) -> Tensor:
        """int64 (b, n, 2): decoded coordinates of vertices. blocks: (b, n, l), the tokens of the vertices, where signs
        may be visible. logits: (b, n, l, vocabulary)."""
        tokenizer, axes = self.tokenizer, []
        for slot in (tokenizer.x_slot, tokenizer.y_slot):
            digits = logits[..., slot + 1 : slot + 1 + len(tokenizer.coord_places), :]
            distribution = number_distribution(digits, tokenizer, tokenizer.coord_places)
            size = decode(distribution, self.settings.mode)
            guess = torch.tensor([PLUS, MINUS], device=self.device)[
                logits[..., slot, [PLUS, MINUS]].argmax(-1)
            ]
            sign = torch.where(blocks[..., slot] == MASK, guess, blocks[..., slot])
            axes.append(torch.where(sign == MINUS, -size, size))
        return torch.stack(axes, -1)

    def _sequences(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens (b, l) with masked heights and angles, their kinds (b, l), and (b, n): which vertex block of the
        sequence belongs to each edge of the footprint."""
        tokenizer, num_vertices = self.tokenizer, batch.num_vertices
        parameters, start = tokenizer.canonical(
            tokenizer.quantise(batch.height, batch.xy, batch.angle, num_vertices)
        )
        return *tokenizer.mask_targets(parameters), roll_index(
            num_vertices - start, num_vertices, batch.xy.shape[1]
        )

    def _angle_support(self) -> Tensor:
        return angle_support(self.settings.angle_support).to(self.device)

    def _distributions(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Distributions of the heights (b, 10^k) and of the angles (b, n, 100) from the logits at
        :meth:`Tokenizer.target_positions`."""
        tokenizer = self.tokenizer
        height, angle = logits.tensor_split([len(tokenizer.places)], 1)
        digits = angle.unflatten(1, (-1, len(tokenizer.angle_places)))
        return (
            number_distribution(height, tokenizer, tokenizer.places),
            number_distribution(digits, tokenizer, tokenizer.angle_places),
        )


def _views(batch: Batch, patches: Patches, num_views: int) -> tuple[Batch, Patches]:
    """``num_views`` rotations of a batch and of its patches, one after the other; the first is the batch itself.

    A rotation does not change which points belong to a patch.
    """
    if num_views == 1:
        return batch, patches
    theta = 2 * math.pi * torch.arange(num_views, dtype=torch.float64) / num_views
    cos, sin = theta.cos(), theta.sin()
    matrix = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2).to(batch.xy)
    rows = torch.arange(len(batch.xy), device=batch.xy.device).repeat(num_views)

    def rotate(points: Tensor) -> Tensor:
        xy = torch.einsum("b...i,vij->vb...j", points[..., :2], matrix).flatten(0, 1)
        return torch.cat([xy, points[rows][..., 2:]], -1)

    return (
        replace(batch[rows], xy=rotate(batch.xy)),
        Patches(rotate(patches.centre), rotate(patches.points), patches.valid[rows]),
    )


def _map_on_single_threads(
    function: Callable[[np.ndarray], _Pass | None], items: Iterable[np.ndarray]
) -> Iterator[_Pass | None]:
    """``function`` of each item, in order, by as many workers as torch has threads, each with one thread of torch."""
    num_threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(num_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield from pool.map(function, items)
    finally:
        # the workers have set what new threads begin with
        torch.set_num_threads(num_threads)


def _courtyard_angle(exterior: np.ndarray) -> float:
    slopes = exterior[exterior < 90]
    return float(np.median(slopes if len(slopes) else exterior))


def number_distribution(logits: Tensor, tokenizer: Tokenizer, places: tuple[int, ...]) -> Tensor:
    """(..., 10^k) probabilities of the integers 0 .. 10^k - 1 from logits (..., k, vocabulary) of k digits.

    At each place only its ten digit tokens count.
    """
    joint = torch.ones(*logits.shape[:-2], 1, device=logits.device)
    for index, place in enumerate(places):
        digit = F.softmax(logits[..., index, tokenizer.digit_tokens(place)].float(), -1)
        joint = (joint[..., :, None] * digit[..., None, :]).flatten(-2)
    return joint


def angle_support(support: Literal["roofs", "all"]) -> Tensor:
    """bool (100,): the angles in degrees that may be predicted; "roofs" is the paper's 0, 90 and 20 to 45."""
    allowed = torch.zeros(100, dtype=torch.bool)
    if support == "all":
        allowed[:91] = True
    else:
        allowed[[FLAT_DEG, VERTICAL_DEG, *range(MIN_SLOPE_DEG, MAX_SLOPE_DEG + 1)]] = True
    return allowed


def constrain(distribution: Tensor, allowed: Tensor) -> Tensor:
    """Set the values that are not ``allowed`` (v,) to 0 and renormalise (..., v); uniform where all are 0."""
    masked = distribution * allowed
    total = masked.sum(-1, keepdim=True)
    return torch.where(total > 0, masked / total.clamp_min(1e-30), allowed / allowed.sum())


def decode(distribution: Tensor, mode: Literal["argmax", "median"]) -> Tensor:
    """int64 (...): the most probable value ("argmax"), or the smallest with half of the mass at or below it."""
    if mode == "argmax":
        return distribution.argmax(-1)
    # double: the sum over 10^4 values must not stop short of one half
    cumulated = distribution.double().cumsum(-1)
    return (cumulated < 0.5 * cumulated[..., -1:]).sum(-1)
