"""Poses data set of the Python package movement as netCDF; xarray and `movement.io` open it.

movement's own loaders make times from one frame rate; here the time coordinate holds the frames'
true times.
"""

from __future__ import annotations

from pathlib import Path

from liex_lab.sessions import Session


def write(session: Session, path: Path) -> None:
    """Write netCDF 4.

    Args:
        session: the session.
        path: the .nc file to write.
    """
    # in memory, see `hdf5`
    path.write_bytes(session.to_xarray().to_netcdf(engine="h5netcdf"))
