"""Prints the newest glibc version that a file in a wheel requires."""

import re
import sys
import zipfile

with zipfile.ZipFile(sys.argv[1]) as wheel:
    versions = {
        tuple(map(int, version.split(b".")))
        for name in wheel.namelist()
        for version in re.findall(rb"\0GLIBC_(\d+(?:\.\d+)+)\0", wheel.read(name))
    }
print(".".join(map(str, max(versions))) if versions else "none")
