"""Inference with a trained Point2WSS: from points and footprints to heights and angles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from p2wss.config import Decoding
from p2wss.config import Dvae as DvaeConfig
from p2wss.nets import augment, compute, decoding
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches
from p2wss.nets.builders import training_limits
from p2wss.nets.compute import DeviceName
from p2wss.nets.dataset import BuildingDataset, TrainingLimits, thin
from p2wss.nets.patches import Patches
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.tokenizer import KIND_COORDINATE, KIND_SIGN, MASK, MINUS, PLUS, roll_index
from p2wss.nets.weights import load_model

# rows of labelled buildings at once: on a CPU the activations should fit into the cache
BATCH_SIZE = {"cpu": 16, "cuda": 256}
# longest over shortest ring of such a batch
MAX_LENGTH_RATIO = 1.25
# numbers of vertices that rings are padded to on a GPU, where many buildings are predicted at once
_VERTEX_STEP = 8

S = TypeVar("S")
T = TypeVar("T")


def load_predictor(path: Path, device: DeviceName = "auto") -> Predictor:
    """A trained model on ``device``; "auto" is a GPU if there is one.

    Raises :class:`InputError` for any other file, and for a device that is not available.
    """
    module, config, dvae_config = load_model(path)
    module.to(compute.device_of(device))
    limits = training_limits(config, dvae_config, module.tokenizer)
    return Predictor(module, config.decoding, dvae_config, config.max_vertices, limits)


@dataclass(frozen=True)
class Prediction:
    """Predicted parameters of b buildings.

    eave_height_m: float (b,), eave above ground. angle_deg: per building an angle per edge, over all rings in the
    order of the argument. class_probability: likewise (edges, 3), of 0 degrees, of 90 degrees and of a slope.
    probability: per building (1 + v,), uncalibrated, that the height is within 0.5 m and each angle of the exterior
    within 5 degrees. confidence: float (b,), the expected share of values that are
    (:func:`p2wss.nets.decoding.expected_share`). A footprint too large for the number format has NaN everywhere,
    no probability and confidence 0.
    """

    eave_height_m: np.ndarray
    angle_deg: list[np.ndarray]
    class_probability: list[np.ndarray]
    probability: list[np.ndarray]
    confidence: np.ndarray


@dataclass(frozen=True)
class _Prediction:
    """Values of a batch: height_m (b,), angle_deg (b, n), class_probability (b, n, 3) and, that the height and each
    angle are within their tolerances, probability (b, 1 + n)."""

    height_m: np.ndarray
    angle_deg: np.ndarray
    class_probability: np.ndarray
    probability: np.ndarray


class Predictor:
    """A trained model. Memory does not grow with the number of buildings.

    A building's prediction does not depend on the other buildings of a call, to the last bit. Matrix products round
    differently for other sizes and other numbers of threads, and each sum over padded rows for other padding. So the
    sizes of everything that is computed follow from the building itself: on a CPU it has a forward pass to itself,
    without padding and on one thread (with several threads, several buildings are predicted at a time); on a GPU every
    pass has the same number of rows, padded to the most points and to a multiple of eight vertices.
    """

    def __init__(
        self,
        module: Point2Wss,
        settings: Decoding,
        dvae_config: DvaeConfig,
        max_num_vertices: int,
        limits: TrainingLimits,
    ) -> None:
        """``limits`` are those of the buildings that ``module`` was trained on."""
        self.limits = limits
        self.module = module.eval()
        self.device = next(module.parameters()).device
        self.tokenizer = module.tokenizer
        self.settings = settings
        self.dvae_config = dvae_config
        self._max_num_vertices = max_num_vertices
        self._batch_size = BATCH_SIZE[self.device.type]
        self._rows_per_pass = 1 if self.device.type == "cpu" else BATCH_SIZE["cuda"]

    def with_num_views(self, num_views: int) -> Predictor:
        """The same network with ``num_views`` views of each building, whose probabilities are averaged."""
        settings = self.settings.model_copy(update={"num_rotations": num_views})
        return Predictor(self.module, settings, self.dvae_config, self._max_num_vertices, self.limits)

    @property
    def max_num_vertices(self) -> int:
        """Largest number of vertices of an exterior ring."""
        return self._max_num_vertices

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        """Heights and angles from clouds (n, 3), z above the ground, and the rings of their footprints.

        x and y of cloud and rings share any local frame; the first ring is the exterior, counter-clockwise,
        without a repeated first vertex. Edges of courtyards get the median slope of the exterior's edges, and equal
        probabilities of the classes (paper, section 4.3: a sequence has one ring).

        Raises ``ValueError`` for an empty cloud or too many vertices.
        """
        exterior = [np.asarray(r[0], np.float32) for r in rings]
        self._check(points_m, exterior)
        height = np.full(len(points_m), np.nan)
        confidence = np.zeros(len(points_m))
        angle: list[np.ndarray] = [np.full(sum(map(len, r)), np.nan) for r in rings]
        class_probability = [np.full((len(edges), 3), 1 / 3) for edges in angle]
        probability = [np.zeros(0)] * len(points_m)
        for index, prediction in self._for_each(points_m, exterior, self._decode):
            for row, i in enumerate(index):
                num_edges = len(exterior[i])
                height[i] = prediction.height_m[row]
                angle[i][:num_edges] = prediction.angle_deg[row, :num_edges]
                class_probability[i][:num_edges] = prediction.class_probability[row, :num_edges]
                if len(rings[i]) > 1:
                    angle[i][num_edges:] = _courtyard_angle(angle[i][:num_edges])
                probability[i] = prediction.probability[row, : 1 + num_edges]
                confidence[i] = decoding.expected_share(probability[i])
        return Prediction(height, angle, class_probability, probability, confidence)

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

    def errors(self, dataset: BuildingDataset, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed errors of heights (n,) in m and angles (edges,) in degrees, of labelled buildings whose footprint is
        known."""
        heights = np.empty(len(index), np.float32)
        angles = [np.empty(0)] * len(index)
        num_points, num_vertices = np.diff(dataset.point_offset)[index], dataset.num_vertices[index]
        for rows in self._similar_size_batches(num_points, num_vertices):
            batch = augment.centre(dataset.batch(index[rows], self.dvae_config.num_points, None))
            prediction = self._decode(batch)
            heights[rows] = prediction.height_m - batch.height.numpy()
            difference = prediction.angle_deg - batch.angle.numpy()
            for row, i in enumerate(rows):
                angles[i] = difference[row, : batch.num_vertices[row]]
        return heights, np.concatenate(angles)

    def _similar_size_batches(self, num_points: np.ndarray, num_vertices: np.ndarray) -> Iterator[np.ndarray]:
        """Indices of all buildings in batches of similar sizes, so that hardly any of a batch is padding."""
        order = np.lexsort([np.minimum(num_points, self.dvae_config.num_points), num_vertices])
        vertices = num_vertices[order]
        first = 0
        while first < len(order):
            too_long = int(np.searchsorted(vertices, MAX_LENGTH_RATIO * vertices[first], "right"))
            end = min(too_long, first + max(self._batch_size // self.settings.num_rotations, 1))
            yield order[first:end]
            first = end

    def _check(self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]) -> None:
        for i, (points, ring) in enumerate(zip(points_m, exterior, strict=True)):
            if not len(points):
                raise ValueError(f"building {i} has no points")
            if not 3 <= len(ring) <= self._max_num_vertices:
                raise ValueError(f"building {i} has {len(ring)} vertices, not 3 to {self._max_num_vertices}")

    def _for_each(
        self,
        points_m: Sequence[np.ndarray],
        exterior: Sequence[np.ndarray],
        decode: Callable[[Batch], T],
    ) -> Iterator[tuple[np.ndarray, T]]:
        """The indices of each pass, which are the first rows of its centred batch, and what ``decode`` returns for it;
        without the buildings that the number format cannot represent."""

        def run(index: np.ndarray) -> tuple[np.ndarray, T] | None:
            batch = self._batch([points_m[i] for i in index], [exterior[i] for i in index])
            reach = batch.xy.norm(dim=-1).amax(1) * 10**self.tokenizer.coord_decimals
            rows = np.flatnonzero(reach.numpy() < self.tokenizer.max_coord)
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
        """Numbers of vertices after padding."""
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
        return augment.centre(
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
    def _decode(self, batch: Batch) -> _Prediction:
        """Heights and angles of a centred batch whose footprints are known.

        The probabilities of the views are averaged before values are decoded.
        """
        tokenizer, mode, num_views = self.tokenizer, self.settings.mode, self.settings.num_rotations
        batch = batch.to(self.device)
        patches = batch_patches(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        views, view_patches = _views(batch, patches, num_views)
        parameters, start = tokenizer.canonical(
            tokenizer.quantise(views.height, views.xy, views.angle, views.num_vertices)
        )
        tokens, _ = tokenizer.mask_targets(parameters)
        positions = tokenizer.target_positions(batch.xy.shape[1]).to(self.device)
        heights, angles = self._distributions(self._logits(tokens, views, view_patches, positions))
        back = roll_index(views.num_vertices - start, views.num_vertices, views.xy.shape[1])
        angles = angles.gather(1, back[..., None].expand_as(angles))
        heights = heights.unflatten(0, (num_views, -1)).mean(0)
        angles = angles.unflatten(0, (num_views, -1)).mean(0)
        angles = decoding.constrain(angles, self._angle_support())
        height, angle = decoding.decode(heights, mode), decoding.decode(angles, mode)
        unit = 10.0 ** tokenizer.height_places[-1]
        height_tolerance = round(decoding.HEIGHT_TOLERANCE_M / unit)
        height_probability = decoding.mass_near(heights, height, height_tolerance)
        angle_probability = decoding.mass_near(angles, angle, decoding.ANGLE_TOLERANCE_DEG)
        return _Prediction(
            (height * unit).cpu().numpy(),
            angle.double().cpu().numpy(),
            decoding.class_probability(angles).double().cpu().numpy(),
            torch.cat([height_probability[:, None], angle_probability], 1).double().cpu().numpy(),
        )

    @torch.inference_mode()
    def _decode_all(self, batch: Batch, signs_visible: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights (b,) m, vertices (b, n, 2) m and angles (b, n) degrees of a centred batch, all digits masked."""
        tokenizer, mode = self.tokenizer, self.settings.mode
        batch = batch.to(self.device)
        parameters, start = tokenizer.canonical(
            tokenizer.quantise(batch.height, batch.xy, batch.angle, batch.num_vertices)
        )
        tokens, kind = tokenizer.mask_targets(parameters)
        masked = (kind == KIND_COORDINATE) | ((kind == KIND_SIGN) & (not signs_visible))
        tokens = tokens.masked_fill(masked, MASK)
        patches = batch_patches(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        logits = self._logits(tokens, batch, patches)
        heights, angle = self._distributions(
            logits[:, tokenizer.target_positions(batch.xy.shape[1]).to(self.device)]
        )
        height = decoding.decode(heights, mode)
        angle = decoding.constrain(angle, self._angle_support())
        signs, block_logits = tokenizer.blocks(tokens), tokenizer.blocks(logits)
        axes = []
        for slot in (tokenizer.x_slot, tokenizer.y_slot):
            digits = block_logits[..., slot + 1 : slot + 1 + len(tokenizer.coord_places), :]
            size = decoding.decode(
                decoding.number_distribution(digits, tokenizer, tokenizer.coord_places), mode
            )
            if signs_visible:
                negative = signs[..., slot] == MINUS
            else:
                negative = block_logits[..., slot, [PLUS, MINUS]].argmax(-1) == 1
            axes.append(torch.where(negative, -size, size))
        back = roll_index(batch.num_vertices - start, batch.num_vertices, batch.xy.shape[1])
        xy = torch.stack(axes, -1).gather(1, back[..., None].expand(-1, -1, 2))
        return (
            (height * 10.0 ** tokenizer.height_places[-1]).cpu().numpy(),
            (xy * 10.0**-tokenizer.coord_decimals).cpu().numpy(),
            decoding.decode(angle, mode).gather(1, back).double().cpu().numpy(),
        )

    def _logits(
        self, tokens: Tensor, batch: Batch, patches: Patches, positions: Tensor | None = None
    ) -> Tensor:
        ground_z = batch.ground_z * NETWORK_SCALE
        cloud, valid = self.module.cloud_features(patches, ground_z)
        return self.module.restore(tokens, batch.num_vertices, patches, ground_z, cloud, valid, positions)

    def _angle_support(self) -> Tensor:
        return decoding.angle_support(self.settings.angle_support).to(self.device)

    def _distributions(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Distributions of the heights (b, 10^k) and of the angles (b, n, 100) from the logits at
        :meth:`Tokenizer.target_positions`."""
        tokenizer = self.tokenizer
        height, angle = logits.tensor_split([len(tokenizer.height_places)], 1)
        digits = angle.unflatten(1, (-1, len(tokenizer.angle_places)))
        return (
            decoding.number_distribution(height, tokenizer, tokenizer.height_places),
            decoding.number_distribution(digits, tokenizer, tokenizer.angle_places),
        )


def _views(batch: Batch, patches: Patches, num_views: int) -> tuple[Batch, Patches]:
    """``num_views`` rotations of a batch and of its patches, one after the other; the first is the batch itself.

    A rotation does not change the points of a patch.
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


def _map_on_single_threads(function: Callable[[S], T], items: Iterable[S]) -> Iterator[T]:
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
