"""Films and stills of a recording: `python -m emberwatch.render.film lab.recording --out lab.gif`.

`scenes` runs the known model's filter over the recorded frames of one world. `page` draws with
Pillow (``pip install emberwatch[film]``). `__main__` parses flags and writes the file.
"""
