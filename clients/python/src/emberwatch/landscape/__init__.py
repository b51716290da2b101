"""Recorded worlds from rasters of fires: `python -m emberwatch.landscape IN... --out world.npz`.

Reading needs ``pip install emberwatch[landscape]``. `inputs` finds the files, and `order` sorts
them. `raster` (rioxarray), `netcdf` (xarray), `numpy_file`, `perimeters` and `detections`
(geopandas) read the files as `layers`. `schedule` computes the time of each layer, `ground` the
size of cells on the ground (with pyproj). `lengths` defines units, `grid` checks positions and
resamples. `fire` converts times, masks or codes to states, `world` writes the files for
`emberwatch-server --states`, `picture` draws the states, and `__main__` parses the flags.

`python -m emberwatch.landscape land` makes model files with maps. `elevation` computes slopes,
`terrain` implements the formula for slope and wind and writes the model file, `compass` parses
directions, and `land` parses the flags. `flags` holds what both commands parse.
"""
