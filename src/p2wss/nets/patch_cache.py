"""Patches of whole clouds, computed once before the training."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from p2wss.errors import InputError
from p2wss.nets import distributed
from p2wss.nets.batch import UNKNOWN_PATCHES
from p2wss.nets.dataset import BuildingDataset
from p2wss.nets.patches import patch_index
from p2wss.storage import files, integrity
from p2wss.storage.progress import Progress

log = logging.getLogger("p2wss")

_BATCH_SIZE = 128


@dataclass(frozen=True)
class PatchSettings:
    """How clouds are cut into patches; clouds of more than ``num_points`` are subsampled before."""

    num_points: int
    num_patches: int
    patch_size: int


def precompute_patches(
    dataset: BuildingDataset, settings: PatchSettings, device: torch.device
) -> BuildingDataset:
    """The same buildings with the patches of every cloud that no batch thins (``settings.num_points``).

    They are computed once and written to one file beside the decoded clouds, completely or not at all; of several
    processes the main one does it and the others wait. A dataset without a folder keeps them in memory. Raises
    :class:`InputError` for a file that cannot be written or read.
    """
    shape = (len(dataset), settings.num_patches, settings.patch_size)
    if dataset.folder is None:
        index = np.empty(shape, np.int16)
        _fill_patch_index(dataset, settings, device, index)
        return replace(dataset, patch_index=index)
    name = f"patches-{settings.num_points}-{settings.num_patches}x{settings.patch_size}.i16"
    path = dataset.folder / name
    if distributed.rank() == 0 and not integrity.is_usable(path):
        if path.is_file():
            log.warning("%s: damaged; computing the patches again", path)
        with files.atomic(path, seal=True) as temporary:
            files.reserve(temporary, 2 * math.prod(shape))
            mapped = np.memmap(temporary, np.int16, "r+", shape=shape)
            _fill_patch_index(dataset, settings, device, mapped)
            mapped.flush()
    distributed.barrier()
    try:
        mapped = np.memmap(path, np.int16, "r", shape=shape)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable ({error}); delete it") from error
    return replace(dataset, patch_index=mapped.view(np.ndarray))


def _fill_patch_index(
    dataset: BuildingDataset, settings: PatchSettings, device: torch.device, index: np.ndarray
) -> None:
    """Fill ``index`` (n, g, k), with ``UNKNOWN_PATCHES`` for clouds that are subsampled."""
    count = np.diff(dataset.point_offset)
    # clouds of similar size together: little of a batch is padding
    order = np.argsort(count, kind="stable")
    whole = order[count[order] <= min(settings.num_points, np.iinfo(np.int16).max)]
    index[order[len(whole) :]] = UNKNOWN_PATCHES
    with Progress("patches", len(whole), "clouds") as progress:
        for first in range(0, len(whole), _BATCH_SIZE):
            rows = whole[first : first + _BATCH_SIZE]
            batch = dataset.batch(rows, settings.num_points, None).to(device)
            patches = patch_index(batch.points, batch.valid, settings.num_patches, settings.patch_size)
            index[rows] = patches.cpu().numpy()
            progress.update(first + len(rows))
