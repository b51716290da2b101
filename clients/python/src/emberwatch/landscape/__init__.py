"""Recorded worlds from rasters of fires: `python -m emberwatch.landscape IN... --out world.npz`.

Reading needs ``pip install emberwatch[landscape]``. `inputs` finds the files. `raster` (rasterio),
`netcdf` (xarray) and `perimeters` (geopandas) read the files as `layers`. `times` computes the step
of each layer, `grid` measures cells on the ground (pyproj) and resamples. `fire` converts times,
masks or codes to states, `world` writes the files for `emberwatch-server --states`, and `__main__`
parses the flags.

`python -m emberwatch.landscape land` makes model files with maps. `terrain` computes slopes,
implements the formula for slope and wind and writes the model file, and `land` parses the flags.
`flags` holds what both commands parse.
"""
