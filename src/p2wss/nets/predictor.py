"""The trained Point2WSS at work: from points and footprints to heights and angles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from p2wss.config import Decoding
from p2wss.config import Dvae as DvaeConfig
from p2wss.nets import augment, compute, dataset, decoding
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches
from p2wss.nets.builders import training_limits
from p2wss.nets.compute import DeviceName
from p2wss.nets.dataset import BuildingDataset, TrainingLimits
from p2wss.nets.patches import Patches
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.tokenizer import KIND_COORDINATE, KIND_SIGN, MASK, MINUS, PLUS, roll_index
from p2wss.nets.weights import load_model

# on a CPU what lies between two layers should fit into the cache: 64 take a tenth longer
INFERENCE_BATCH = {"cpu": 16, "cuda": 256}
# longest ring of such a batch over its shortest
PADDED_VERTICES = 1.25


def load_predictor(path: Path, device: DeviceName = "auto") -> Predictor:
    """A trained model, ready to use, on a GPU where there is one.

    Raises :class:`InputError` for a file that is none, and for a device that there is not.
    """
    module, config, dvae_config = load_model(path)
    module.to(compute.device_of(device))
    limits = training_limits(config, dvae_config, module.tokenizer)
    return Predictor(module, config.decoding, dvae_config, config.max_vertices, limits)


@dataclass(frozen=True)
class Prediction:
    """Decoded parameters of a batch of b buildings.

    eave_height_m: float (b,), gutter above ground. angle_deg: per building one value per edge over all rings,
    in the order of the rings given; class_probability: (.., 3) likewise, of 0 degrees, of 90 degrees and of a
    slope. probability: per building (1 + v,), as the network tells it: that the height is within 0.5 m and each
    angle of the exterior within 5 degrees. confidence: float (b,), the share of these that is to be expected
    (:func:`p2wss.nets.decoding.expected_share`). A footprint too large for the number format has NaN everywhere,
    no probability and confidence 0.
    """

    eave_height_m: np.ndarray
    angle_deg: list[np.ndarray]
    class_probability: list[np.ndarray]
    probability: list[np.ndarray]
    confidence: np.ndarray


class Predictor:
    """A trained model. Memory is bounded whatever the number of buildings; results depend on no order."""

    def __init__(
        self,
        module: Point2Wss,
        decode: Decoding,
        dvae_config: DvaeConfig,
        max_num_vertices: int,
        limits: TrainingLimits,
    ) -> None:
        # of the buildings that it was trained on
        self.limits = limits
        self.module = module.eval()
        self.device = next(module.parameters()).device
        self.tokenizer = module.tokenizer
        self.decode = decode
        self.dvae_config = dvae_config
        self._max_num_vertices = max_num_vertices
        self._batch_size = INFERENCE_BATCH[self.device.type]

    def with_num_views(self, num_rotations: int) -> Predictor:
        """The same network, asked for so many views: one is enough for a start that is fitted afterwards."""
        decode = self.decode.model_copy(update={"num_rotations": num_rotations})
        return Predictor(self.module, decode, self.dvae_config, self._max_num_vertices, self.limits)

    @property
    def max_num_vertices(self) -> int:
        """Largest number of vertices of an exterior ring."""
        return self._max_num_vertices

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        """Heights and angles from clouds (n, 3), z above the ground, and the rings of their footprints.

        x and y of cloud and rings share any local frame; the first ring is the exterior, counter-clockwise,
        without a repeated first vertex. Edges of courtyards get the median slope of the exterior's and even
        odds of the classes (paper, section 4.3: a sequence has one ring).

        Raises ``ValueError`` for an empty cloud or too many vertices.
        """
        exterior = [np.asarray(r[0], np.float32) for r in rings]
        self._check(points_m, exterior)
        height = np.full(len(points_m), np.nan)
        confidence = np.zeros(len(points_m))
        angle: list[np.ndarray] = [np.full(sum(map(len, r)), np.nan) for r in rings]
        odds = [np.full((len(own), 3), 1 / 3) for own in angle]
        probability = [np.zeros(0)] * len(points_m)
        for index, batch in self._batches(points_m, exterior):
            heights, angles, classes, sure = self._decode(batch)
            for row, i in enumerate(index):
                height[i], probability[i] = heights[row], sure[row, : 1 + len(exterior[i])]
                confidence[i] = decoding.expected_share(probability[i])
                own = angles[row, : len(exterior[i])]
                odds[i][: len(own)] = classes[row, : len(own)]
                angle[i][: len(own)] = own
                if len(rings[i]) > 1:
                    angle[i][len(own) :] = _courtyard_angle(own)
        return Prediction(height, angle, odds, probability, confidence)

    def reconstruct_all_masked(
        self,
        points_m: Sequence[np.ndarray],
        footprints_m: Sequence[np.ndarray],
        signs_visible: bool = True,
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Table 1: height, footprint and angles with all numerical tokens masked.

        Of the footprints only the number of vertices, the order and, if ``signs_visible``, the signs of the
        centred coordinates reach the network. Arguments as in :meth:`predict`, exterior rings only. Returns
        heights (b,), footprints [(v, 2)] in the frame and vertex order given, and angles [(v,)].
        """
        exterior = [np.asarray(ring, np.float32) for ring in footprints_m]
        self._check(points_m, exterior)
        height = np.full(len(points_m), np.nan)
        xy: list[np.ndarray] = [np.full(ring.shape, np.nan) for ring in exterior]
        angle: list[np.ndarray] = [np.full(len(ring), np.nan) for ring in exterior]
        for index, batch in self._batches(points_m, exterior):
            heights, places, angles = self._decode_all(batch, signs_visible)
            # the batch is centred: its first vertex tells by how much
            for row, i in enumerate(index):
                num = len(exterior[i])
                shift = exterior[i][0] - batch.xy[row, 0].numpy()
                height[i], angle[i], xy[i] = heights[row], angles[row, :num], places[row, :num] + shift
        return height, xy, angle

    def errors(self, buildings: BuildingDataset, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed errors, footprint given, of labelled buildings: heights (n,) m, angles (edges,) degrees."""
        heights = np.empty(len(index), np.float32)
        angles = [np.empty(0)] * len(index)
        for own in self._similar_size_batches(
            np.diff(buildings.point_offset)[index], buildings.num_vertices[index]
        ):
            batch = augment.centre(buildings.batch(index[own], self.dvae_config.num_points, None))
            height, angle, _, _ = self._decode(batch)
            heights[own] = height - batch.height.numpy()
            wrong = angle - batch.angle.numpy()
            for row, i in enumerate(own):
                angles[i] = wrong[row, : batch.num_vertices[row]]
        return heights, np.concatenate(angles)

    def _similar_size_batches(self, num_points: np.ndarray, num_vertices: np.ndarray) -> Iterator[np.ndarray]:
        """Indices (n,) of all buildings, by batches of similar sizes: hardly any of a batch is padding."""
        order = np.lexsort([np.minimum(num_points, self.dvae_config.num_points), num_vertices])
        vertices = num_vertices[order]
        first = 0
        while first < len(order):
            longer = int(np.searchsorted(vertices, PADDED_VERTICES * vertices[first], "right"))
            last = min(longer, first + self._batch_size)
            yield order[first:last]
            first = last

    def _check(self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]) -> None:
        for i, (points, ring) in enumerate(zip(points_m, exterior, strict=True)):
            if not len(points):
                raise ValueError(f"building {i} has no points")
            if not 3 <= len(ring) <= self._max_num_vertices:
                raise ValueError(f"building {i} has {len(ring)} vertices, not 3 to {self._max_num_vertices}")

    def _batches(
        self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]
    ) -> Iterator[tuple[np.ndarray, Batch]]:
        """Centred batches of similar sizes; buildings that the number format cannot hold are left out."""
        for index in self._similar_size_batches(
            np.array([*map(len, points_m)]), np.array([*map(len, exterior)])
        ):
            batch = self._batch([points_m[i] for i in index], [exterior[i] for i in index])
            reach = batch.xy.norm(dim=-1).amax(1) * 10**self.tokenizer.coord_decimals
            fits = reach.numpy() < self.tokenizer.max_coord
            if fits.all():
                yield index, batch
            elif fits.any():
                rows = torch.from_numpy(fits)
                yield index[fits], batch[rows]

    def _batch(self, points_m: Sequence[np.ndarray], exterior: Sequence[np.ndarray]) -> Batch:
        num_points = self.dvae_config.num_points
        chosen = [points[dataset.thin(len(points), num_points)] for points in points_m]
        num_vertices = np.array([len(ring) for ring in exterior])
        width = max(map(len, chosen))
        points = np.zeros((len(chosen), width, 3), np.float32)
        valid = np.zeros((len(chosen), width), bool)
        xy = np.zeros((len(chosen), num_vertices.max(), 2), np.float32)
        for row, (cloud, ring) in enumerate(zip(chosen, exterior, strict=True)):
            points[row, : len(cloud)] = cloud
            valid[row, : len(cloud)] = True
            xy[row, : len(ring)] = ring
        return augment.centre(
            Batch(
                points=torch.from_numpy(points),
                valid=torch.from_numpy(valid),
                ground_z=torch.zeros(len(chosen)),
                height=torch.zeros(len(chosen)),
                xy=torch.from_numpy(xy),
                angle=torch.zeros(xy.shape[:2]),
                num_vertices=torch.from_numpy(num_vertices),
            )
        )

    @torch.inference_mode()
    def _decode(self, batch: Batch) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Heights (b,) m, angles (b, n) degrees, probabilities of their classes (b, n, 3) and of the height and
        each angle to be right (b, 1 + n) of a centred batch, footprint given.

        The probabilities of ``num_rotations`` views are averaged before anything is decided.
        """
        tokenizer, decode = self.tokenizer, self.decode
        batch = batch.to(self.device)
        patches = batch_patches(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        heights = angles = torch.zeros((), device=self.device)
        asked = tokenizer.target_positions(batch.xy.shape[1]).to(self.device)
        for view in range(decode.num_rotations):
            turned, seen = _turned(batch, patches, 2 * math.pi * view / decode.num_rotations)
            parameters, start = tokenizer.canonical(
                tokenizer.quantise(turned.height, turned.xy, turned.angle, turned.num_vertices)
            )
            tokens, _ = tokenizer.masked(parameters)
            height, angle = self._distributions(self._logits(tokens, turned, seen, asked))
            heights = heights + height
            back = roll_index(batch.num_vertices - start, batch.num_vertices, batch.xy.shape[1])
            angles = angles + angle.gather(1, back[..., None].expand_as(angle))
        heights = heights / decode.num_rotations
        angles = decoding.constrain(angles, decoding.angle_support(decode.angle_support).to(self.device))
        height, angle = decoding.decode(heights, decode.mode), decoding.decode(angles, decode.mode)
        unit = 10.0 ** tokenizer.height_places[-1]
        sure_height = decoding.mass_near(heights, height, round(decoding.CONFIDENT_HEIGHT_M / unit))
        sure_angle = decoding.mass_near(angles, angle, decoding.CONFIDENT_ANGLE_DEG)
        return (
            (height * unit).cpu().numpy(),
            angle.double().cpu().numpy(),
            decoding.class_probability(angles).double().cpu().numpy(),
            torch.cat([sure_height[:, None], sure_angle], 1).double().cpu().numpy(),
        )

    @torch.inference_mode()
    def _decode_all(self, batch: Batch, signs_visible: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights (b,) m, vertices (b, n, 2) m and angles (b, n) degrees of a centred batch, all masked."""
        tokenizer, mode = self.tokenizer, self.decode.mode
        batch = batch.to(self.device)
        parameters, start = tokenizer.canonical(
            tokenizer.quantise(batch.height, batch.xy, batch.angle, batch.num_vertices)
        )
        tokens, kind = tokenizer.masked(parameters)
        hidden = (kind == KIND_COORDINATE) | ((kind == KIND_SIGN) & (not signs_visible))
        tokens = tokens.masked_fill(hidden, MASK)
        patches = batch_patches(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        logits = self._logits(tokens, batch, patches)
        heights, angle = self._distributions(
            logits[:, tokenizer.target_positions(batch.xy.shape[1]).to(self.device)]
        )
        height = decoding.decode(heights, mode)
        angle = decoding.constrain(angle, decoding.angle_support(self.decode.angle_support).to(self.device))
        signs, block_logits = tokenizer.blocks(tokens), tokenizer.blocks(logits)
        axes = []
        for slot in (tokenizer.x_slot, tokenizer.y_slot):
            digits = block_logits[..., slot + 1 : slot + 1 + len(tokenizer.coord_places), :]
            size = decoding.decode(
                decoding.number_distribution(digits, tokenizer, tokenizer.coord_places), mode
            )
            guessed = block_logits[..., slot, [PLUS, MINUS]].argmax(-1) == 1
            negative = signs[..., slot] == MINUS if signs_visible else guessed
            axes.append(torch.where(negative, -size, size))
        back = roll_index(batch.num_vertices - start, batch.num_vertices, batch.xy.shape[1])
        xy = torch.stack(axes, -1).gather(1, back[..., None].expand(-1, -1, 2))
        return (
            (height * 10.0 ** tokenizer.height_places[-1]).cpu().numpy(),
            (xy * 10.0**-tokenizer.coord_decimals).cpu().numpy(),
            decoding.decode(angle, mode).gather(1, back).double().cpu().numpy(),
        )

    def _logits(self, tokens: Tensor, batch: Batch, patches: Patches, asked: Tensor | None = None) -> Tensor:
        ground_z = batch.ground_z * NETWORK_SCALE
        cloud, valid = self.module.cloud_features(patches, ground_z)
        return self.module.restore(tokens, batch.num_vertices, patches, ground_z, cloud, valid, asked)

    def _distributions(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Of the heights (b, 10^k) and of the angles (b, n, 100), from logits at ``Tokenizer.target_positions``."""
        tokenizer = self.tokenizer
        height, angle = logits.tensor_split([len(tokenizer.height_places)], 1)
        digits = angle.unflatten(1, (-1, len(tokenizer.angle_places)))
        return (
            decoding.number_distribution(height, tokenizer, tokenizer.height_places),
            decoding.number_distribution(digits, tokenizer, tokenizer.angle_places),
        )


def _turned(batch: Batch, patches: Patches, theta: float) -> tuple[Batch, Patches]:
    """A batch and its patches rotated by ``theta``: which points make a patch does not depend on it."""
    if theta == 0:
        return batch, patches
    matrix = batch.xy.new_tensor([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])

    def turn(points: Tensor) -> Tensor:
        return torch.cat([points[..., :2] @ matrix, points[..., 2:]], -1)

    return (
        replace(batch, xy=batch.xy @ matrix),
        Patches(turn(patches.centre), turn(patches.points), patches.valid),
    )


def _courtyard_angle(exterior: np.ndarray) -> float:
    slopes = exterior[exterior < 90]
    return float(np.median(slopes if len(slopes) else exterior))
