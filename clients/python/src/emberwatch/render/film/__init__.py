"""Films and stills of a recording: `python -m emberwatch.render.film lab.recording --out lab.gif`.

`scenes` runs the known model's filter along what a recording holds of one world, `page` draws (with
Pillow: ``pip install emberwatch[film]``), `__main__` reads flags and writes.
"""
