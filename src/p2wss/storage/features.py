"""Rows with a geometry each, like a GeoDataFrame, but without pandas, which takes as long to load as ten houses take to
reconstruct, and 70 MiB."""

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
        """The features at ``rows``: indices, in that order, or a mask."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return replace(self, geometry=self.geometry[rows], columns=columns)

    def having(self, **columns: np.ndarray) -> Features:
        """The features with these columns added, or replacing columns of the same names."""
        return replace(self, columns={**self.columns, **columns})

    def without(self, name: str) -> Features:
        """The features without a column."""
        return replace(self, columns={each: self.columns[each] for each in self.columns if each != name})

    @classmethod
    def joined(cls, parts: Sequence[Features]) -> Features:
        """The rows of all parts, at least one, which have the same columns and CRS."""
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0].columns}
        return cls(np.concatenate([part.geometry for part in parts]), columns, parts[0].crs)

    def to_frame(self) -> gpd.GeoDataFrame:
        """The features as a table of geopandas. Integers with missing values get the type of pandas for them."""
        import geopandas as gpd
        import pandas as pd

        columns: dict[str, Any] = dict(self.columns)
        for name, column in columns.items():
            values, missing = without_none(column)
            if missing.any() and values.dtype == int:  # objects can be neither added nor compared
                columns[name] = pd.arrays.IntegerArray(values, missing)
        return gpd.GeoDataFrame(columns, geometry=self.geometry, crs=self.crs)


def without_none(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values, which are missing), each (n,). Objects that are all integers or None, or all bool or None, become an
    array of that type with 0 for None. Other values are returned unchanged, with none missing."""
    given = values.tolist()
    missing = np.array([each is None for each in given], bool)
    known = {type(each) for each in given} - {type(None)}
    if values.dtype != object or known not in ({int}, {bool}):
        return values, np.zeros(len(values), bool)
    return np.array([each or 0 for each in given], known.pop()), missing


def columns_of(frame: pd.DataFrame) -> dict[str, np.ndarray]:
    """The columns of a table of pandas. Missing values are NaN in numeric columns, and None in columns of objects."""
    return {
        str(name): values.to_numpy()
        if isinstance(values.dtype, np.dtype) and values.dtype.kind in "biuf"
        else values.astype(object).where(values.notna(), None).to_numpy()
        for name, values in frame.items()
    }
