"""Recorded worlds from rasters of fires: `python -m emberwatch.landscape IN... --out world.npz`.

`inputs` finds files; `raster` (with rasterio), `netcdf` (with netCDF4; its `axes` and `packing`
know CF) and `numpy_file` read them as `layers`; ``pip install emberwatch[landscape]``. `schedule`
says when layers are, `ground` how large cells are on the ground (with pyproj), `lengths` knows
units, `grid` checks where cells are and resamples, `fire` makes states of times, masks or codes,
`world` writes what `emberwatch-server --states` reads, `picture` draws it, `__main__` reads flags.

`python -m emberwatch.landscape land` makes model files with zones: `elevation` computes slopes,
`terrain` finds zones and has the formula of slope and wind, `compass` names directions, `zoned`
writes kernels for each, `land` reads flags.
"""
