"""A conformance set for KHR_gaussian_splatting: small .glb files, expected numbers and pictures, and invalid files.

`python -m tests.conformance.gaussian_splatting` writes all of it anew; a test compares the bytes. It uses no writer of
nerfbake.
"""
