"""Read a window of a GeoParquet file of any size."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd
import pyarrow.parquet as pq
import shapely

from p2wss.data.tiling import Bounds

_BATCH_ROWS = 65_536


def read_window(path: Path, window_in: Callable[[Any], Bounds]) -> gpd.GeoDataFrame:
    """The features whose bounding boxes intersect a window. window_in: gives the window in a CRS.

    If the file has the bounding boxes in a covering column, as IGN's files do, only the row groups that
    intersect the window are read. Otherwise the file is read batch by batch.
    """
    empty = _read_empty(path)
    x_min, y_min, x_max, y_max = window_in(empty.crs)
    try:
        return gpd.read_parquet(path, bbox=(x_min, y_min, x_max, y_max))
    except ValueError as error:
        if "bbox" not in str(error):
            raise
    name = empty.geometry.name
    parts = [empty]
    for batch in pq.ParquetFile(path).iter_batches(_BATCH_ROWS):
        geometry = shapely.from_wkb(batch.column(name).to_numpy(zero_copy_only=False))
        boxes = shapely.bounds(geometry)
        mask = (boxes[:, :2] <= (x_max, y_max)).all(axis=1) & (boxes[:, 2:] >= (x_min, y_min)).all(axis=1)
        if mask.any():
            rows = batch.filter(mask).to_pandas().assign(**{name: geometry[mask]})
            parts.append(gpd.GeoDataFrame(rows, geometry=name, crs=empty.crs))
    return pd.concat(parts, ignore_index=True) if len(parts) > 1 else empty


def _read_empty(path: Path) -> gpd.GeoDataFrame:
    """A frame with the columns and the CRS of a file, without rows."""
    buffer = BytesIO()
    pq.write_table(pq.read_schema(path).empty_table(), buffer)
    return gpd.read_parquet(buffer)
