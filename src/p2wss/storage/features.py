"""Rows with a geometry each: a GeoDataFrame without pandas, which takes as long to load as ten houses, and 70 MiB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj

if TYPE_CHECKING:
    import geopandas as gpd
    import pandas as pd


@dataclass(frozen=True)
class Features:
    """n features of a vector file or of a table.

    geometry: of shapely, object (n,); None without one. columns: by name, each (n,). crs: None if it is not known.
    """

    geometry: np.ndarray
    columns: Mapping[str, np.ndarray]
    crs: pyproj.CRS | None = None

    @classmethod
    def of(cls, frame: gpd.GeoDataFrame) -> Features:
        """The rows of a table of geopandas."""
        return cls(frame.geometry.to_numpy(), columns_of(frame.drop(columns=frame.geometry.name)), frame.crs)

    def __len__(self) -> int:
        return len(self.geometry)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def take(self, rows: np.ndarray) -> Features:
        """These rows: numbers of them, in that order, or a mask."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return replace(self, geometry=self.geometry[rows], columns=columns)

    def having(self, **columns: np.ndarray) -> Features:
        """The same with these columns, too, or in place of those of their names."""
        return replace(self, columns={**self.columns, **columns})

    def without(self, name: str) -> Features:
        """The same without a column."""
        return replace(self, columns={each: self.columns[each] for each in self.columns if each != name})

    @classmethod
    def joined(cls, parts: Sequence[Features]) -> Features:
        """The rows of all parts, at least one, which have the same columns and CRS."""
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0].columns}
        return cls(np.concatenate([part.geometry for part in parts]), columns, parts[0].crs)

    def to_frame(self) -> gpd.GeoDataFrame:
        """The same as a table of geopandas."""
        import geopandas as gpd
        import pandas as pd

        columns: dict[str, Any] = dict(self.columns)
        for name, column in columns.items():
            values, missing = without_none(column)
            if missing.any() and values.dtype == int:  # objects can be neither added nor compared
                columns[name] = pd.arrays.IntegerArray(values, missing)
        return gpd.GeoDataFrame(columns, geometry=self.geometry, crs=self.crs)


def without_none(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values, which are missing), each (n,): of objects that are whole numbers or truths beside None, these as such,
    with 0 for None; of all others the same, without any that is missing."""
    given = values.tolist()
    missing = np.array([each is None for each in given], bool)
    known = {type(each) for each in given} - {type(None)}
    if values.dtype != object or known not in ({int}, {bool}):
        return values, np.zeros(len(values), bool)
    return np.array([each or 0 for each in given], known.pop()), missing


def columns_of(frame: pd.DataFrame) -> dict[str, np.ndarray]:
    """The columns of a table of pandas: numbers with NaN, and objects with None, for what is missing."""
    return {
        str(name): values.to_numpy()
        if isinstance(values.dtype, np.dtype) and values.dtype.kind in "biuf"
        else values.astype(object).where(values.notna(), None).to_numpy()
        for name, values in frame.items()
    }
