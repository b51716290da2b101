"""Recorded worlds from rasters of fires: `python -m emberwatch.landscape IN... --out world.npz`.

`layers` reads files (with rasterio: ``pip install emberwatch[landscape]``), `schedule` says when
layers are, `grid` checks where their cells are and resamples, `fire` makes states of times, masks
or codes, `world` writes what `emberwatch-server --states` reads, `picture` draws it, `__main__`
reads flags.
"""
